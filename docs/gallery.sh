#!/usr/bin/env bash
# Makes the pictures of docs/gallery.md: docs/gallery.sh [demo] [court] [cornell] [sponza] [sponza_sky] [autzen], all by default.
#
# Programs are those of target/release, built if need be, or of the folder PBGI_BIN. Scenes whose data is not in `shared/data`, beside
# the repository or above it, are skipped, loudly. Everything but the pictures goes to a temporary folder.
set -euo pipefail
cd "$(dirname "$0")/.."

scenes=(demo court cornell sponza sponza_sky autzen)
[ $# -gt 0 ] || set -- "${scenes[@]}"
for scene in "$@"; do
    if [ "$scene" = --help ]; then
        sed -n '2,/^set /{/^#/s/^# \?//p}' "$0"
        exit
    elif ! [[ " ${scenes[*]} " == *" $scene "* ]]; then
        echo "error: no scene $scene; choose from: ${scenes[*]}" >&2
        exit 2
    fi
done

images=$PWD/docs/images
bytes_max=400000
bin=${PBGI_BIN:-target/release}
[ -n "${PBGI_BIN:-}" ] || cargo build --release --locked
bin=$(cd "$bin" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

pbgi() { "$bin/pbgi-client" "$@"; }

# The path of a file of shared/data, or nothing and a word that scene $1 is skipped.
data() {
    local folder=$PWD
    while [ "$folder" != / ]; do
        folder=$(dirname "$folder")
        if [ -e "$folder/shared/data/$2" ]; then
            echo "$folder/shared/data/$2"
            return
        fi
    done
    echo "SKIPPED $1: it needs shared/data/$2, which is not there" >&2
    return 1
}

demo() {
    pbgi demo -o "$work/demo.exr"
    mv "$work/demo.png" "$images/demo.png"
}

court() {
    pbgi render docs/examples/court.toml -o "$work/court.exr" --png "$images/court.png" --overwrite --size 800x450 --exposure 0.6
}

cornell() {
    pbgi render docs/examples/cornell.glb -o "$work/cornell.exr" --png "$images/cornell.png" --overwrite --size 480x480
}

sponza() {
    local mesh
    mesh=$(data sponza sponza/sponza_lit.gltf) || return 0
    pbgi render "$mesh" -o "$work/sponza.exr" --png "$images/sponza.png" --overwrite --view-spacing 1 --size 544x306
}

sponza_sky() {
    local mesh sky
    mesh=$(data sponza_sky sponza/sponza_lit.gltf) || return 0
    sky=$(data sponza_sky kiara_1_dawn_1k.hdr) || return 0
    pbgi render "$mesh" -o "$work/sponza_sky.exr" --png "$images/sponza_sky.png" --overwrite --view-spacing 1 --size 544x306 \
        --environment "$sky"
}

autzen() {
    local cloud
    cloud=$(data autzen autzen_10.6M_rgb.laz) || return 0
    pbgi build "$cloud" -o "$work/autzen.pbgi" --estimate-normals --radius auto --memory 512M
    pbgi view "$work/autzen.pbgi" -o "$images/autzen.png" --overwrite --size 720x480 --memory 512M
}

for scene in "$@"; do
    echo "== $scene" >&2
    "$scene"
    if [ -e "$images/$scene.png" ] && [ "$(stat -c %s "$images/$scene.png")" -gt "$bytes_max" ]; then
        echo "error: $scene.png has more than $bytes_max bytes: make it smaller" >&2
        exit 1
    fi
done
