#!/usr/bin/env bash
# Makes pbgi-VERSION-x86_64-linux.tar.gz and its checksum in the folder given (target/release-archive by default): programs that run
# where glibc is 2.28 or later, completions, manual pages, units, licences, the documents. The same commit gives the same archive.
#
# Needs cargo-zigbuild and zig, which PyPI has: pip install cargo-zigbuild ziglang
set -euo pipefail
cd "$(dirname "$0")/.."

glibc=2.28
target=x86_64-unknown-linux-gnu
programs=(pbgi-client pbgi-server pbgi-worker)
version=$(sed -n '/^\[workspace.package\]/,/^\[/s/^version = "\(.*\)"/\1/p' Cargo.toml)
name=pbgi-$version-x86_64-linux
out=${1:-target/release-archive}
mkdir -p "$out"
out=$(cd "$out" && pwd)
export SOURCE_DATE_EPOCH
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)

# Line tables stay in the building folder: they are most of a program's bytes.
export CARGO_PROFILE_RELEASE_STRIP=debuginfo
cargo zigbuild --release --locked --features usd --target "$target.$glibc"
built=${CARGO_TARGET_DIR:-target}/$target/release

stage=$(mktemp -d)
trap 'rm -rf "$stage"' EXIT
root=$stage/$name
install -d "$root/bin" "$root/share/man/man1" "$root/share/doc/pbgi" "$root/lib/systemd/system" \
    "$root/share/bash-completion/completions" "$root/share/zsh/site-functions" "$root/share/fish/vendor_completions.d"

for program in "${programs[@]}"; do
    install -m 755 "$built/$program" "$root/bin/"
    newest=$(objdump -T "$root/bin/$program" | grep -o 'GLIBC_[0-9.]*' | sort -uV | tail -1)
    if [ "$(printf '%s\n' "GLIBC_$glibc" "$newest" | sort -V | tail -1)" != "GLIBC_$glibc" ]; then
        echo "error: $program needs $newest, more than GLIBC_$glibc" >&2
        exit 1
    fi
    echo "$program needs $newest or later" >&2
done

for program in pbgi-client pbgi-server; do
    "$root/bin/$program" man "$root/share/man/man1"
    "$root/bin/$program" completions bash > "$root/share/bash-completion/completions/$program"
    "$root/bin/$program" completions zsh > "$root/share/zsh/site-functions/_$program"
    "$root/bin/$program" completions fish > "$root/share/fish/vendor_completions.d/$program.fish"
done

install -m 644 deploy/*.service deploy/*.socket "$root/lib/systemd/system/"
install -m 644 README.md LICENSE-MIT LICENSE-APACHE deploy/server.toml "$root/share/doc/pbgi/"
cp -r docs "$root/share/doc/pbgi/docs"

# What the packages in the programs ask to be shipped with them: their licences and notices, as they are in their sources.
cargo metadata --format-version 1 --locked --filter-platform "$target" > "$stage/metadata.json"
cargo tree --locked --target "$target" --edges normal --prefix none --format '{p}' \
    --package pbgi-client --package pbgi-server --package pbgi-worker | sed 's/ (.*//; s/ v/ /' | sort -u > "$stage/packages"
python3 - "$stage/metadata.json" "$stage/packages" > "$root/share/doc/pbgi/THIRD-PARTY.txt" <<'PYTHON'
import json, pathlib, sys

used = {tuple(line.split()) for line in open(sys.argv[2])}
for package in sorted(json.load(open(sys.argv[1]))["packages"], key=lambda package: package["id"]):
    if package["source"] is None or (package["name"], package["version"]) not in used:
        continue
    print(f"{'=' * 100}\n{package['name']} {package['version']}: {package['license']}\n{package['repository'] or ''}\n")
    folder = pathlib.Path(package["manifest_path"]).parent
    texts = [path for path in sorted(folder.iterdir()) if path.name.upper().startswith(("LICEN", "COPYING", "NOTICE", "UNLICENSE"))]
    for path in texts:
        if path.is_file():
            print(f"{'-' * 20} {path.name}\n{path.read_text(errors='replace').strip()}\n")
PYTHON

tar --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$SOURCE_DATE_EPOCH" --mode=go-w -C "$stage" -cf - "$name" \
    | gzip -9n > "$out/$name.tar.gz"
(cd "$out" && sha256sum "$name.tar.gz" > "$name.tar.gz.sha256")
ls -l "$out/$name.tar.gz" >&2
