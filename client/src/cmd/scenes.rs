//! Scenes that `render` has built, kept so that the second render of a mesh starts warm.
//!
//! They lie in `XDG_CACHE_HOME/pbgi/scenes` under a digest of the mesh file, of the files it names, of the sampling density and
//! of the program's version. The few used last stay; a note beside each says what it was made of.

use super::failure::Failure;
use nix::fcntl::{Flock, FlockArg};
use pbgi_points::Density;
use std::collections::BTreeSet;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

/// Scenes kept; the least recently used ones go.
const SCENES_KEPT: usize = 8;
/// Until another command has built the scene that this one needs, polled.
const LOCK_POLL: std::time::Duration = std::time::Duration::from_millis(100);
/// Largest JSON text of a mesh file that is searched for file names.
const JSON_MAX: u64 = 1 << 30;

/// The folder of kept scenes.
pub(crate) struct SceneCache {
    folder: PathBuf,
}

/// One scene's place in it; nobody else builds there while this exists.
pub(crate) struct Kept {
    pub(crate) scene: PathBuf,
    note: PathBuf,
    _lock: Flock<File>,
}

impl SceneCache {
    /// Opens the cache under the user's cache folder.
    pub(crate) fn open(cache: &Path) -> Result<Self, Failure> {
        let folder = cache.join("scenes");
        fs::create_dir_all(&folder).map_err(|error| fault("make folder", &folder, &error))?;
        Ok(Self { folder })
    }

    /// The place of the scene with this digest; waits while another command holds it.
    pub(crate) async fn keep(&self, digest: &str) -> Result<Kept, Failure> {
        let path = self.folder.join(format!("{digest}.lock"));
        let open = OpenOptions::new().create(true).append(true).open(&path);
        let mut file = open.map_err(|error| fault("lock", &path, &error))?;
        let lock = loop {
            match Flock::lock(file, FlockArg::LockExclusiveNonblock) {
                Ok(lock) => break lock,
                Err((back, nix::errno::Errno::EWOULDBLOCK)) => file = back,
                Err((_, errno)) => return Err(fault("lock", &path, &errno.into())),
            }
            tokio::time::sleep(LOCK_POLL).await;
        };
        Ok(Kept {
            scene: self.folder.join(format!("{digest}.pbgi")),
            note: self.folder.join(format!("{digest}.txt")),
            _lock: lock,
        })
    }

    /// Removes the scenes used longest ago. Jobs that still read one are not disturbed: the daemon holds it open.
    pub(crate) fn trim(&self) {
        let Ok(entries) = fs::read_dir(&self.folder) else {
            return;
        };
        let notes = entries.flatten().map(|entry| entry.path());
        let mut notes: Vec<_> = notes
            .filter(|path| path.extension().is_some_and(|extension| extension == "txt"))
            .filter_map(|path| Some((fs::metadata(&path).ok()?.modified().ok()?, path)))
            .collect();
        notes.sort();
        for (_, note) in notes.iter().rev().skip(SCENES_KEPT) {
            // What cannot be removed now is tried again next time: the note goes last.
            let gone = fs::remove_dir_all(note.with_extension("pbgi"));
            if gone.is_ok() || gone.is_err_and(|error| error.kind() == io::ErrorKind::NotFound) {
                let _ = fs::remove_file(note.with_extension("lock"));
                let _ = fs::remove_file(note);
            }
        }
    }
}

impl Kept {
    /// Notes that the scene was used just now, and what it is made of.
    pub(crate) fn mark(&self, input: &Path) {
        // Without the note the scene is not trimmed, nothing worse.
        let _ = fs::write(&self.note, format!("{}\n", input.display()));
    }
}

/// Digest of a mesh file, of the files it names, and of how it is sampled; blocks.
pub(crate) fn digest(input: &Path, density: Density) -> Result<String, Failure> {
    let mut digest = Digest::new();
    digest.text(env!("CARGO_PKG_VERSION"));
    digest.text(&format!("{density:?}"));
    let mut paths = vec![input.to_owned()];
    if extension(input) == "toml" {
        paths.extend(pbgi_points::scene_meshes(input)?);
    }
    for index in 0..paths.len() {
        if matches!(extension(&paths[index]).as_str(), "usd" | "usda" | "usdc" | "usdz") {
            paths.extend(pbgi_points::usd_files(&paths[index])?);
            continue;
        }
        let folder = paths[index].parent().unwrap_or(Path::new("/")).to_owned();
        let named = named_files(&paths[index]).into_iter();
        paths.extend(named.map(|name| folder.join(name)));
    }
    for (index, path) in paths.iter().enumerate() {
        match File::open(path) {
            Ok(file) => digest.file(file).map_err(|error| fault("read", path, &error))?,
            Err(error) if index == 0 => return Err(fault("open", path, &error)),
            // Whoever needs it reports that it is missing.
            Err(_) => digest.text("missing"),
        }
    }
    Ok(format!("{:032x}", digest.0))
}

/// Files that a mesh file names, relative to its folder.
fn named_files(input: &Path) -> BTreeSet<String> {
    let found = match extension(input).as_str() {
        "gltf" => File::open(input).ok().and_then(|file| gltf_uris(file.take(JSON_MAX))),
        "glb" => File::open(input).ok().and_then(|file| gltf_uris(glb_json(file)?)),
        "obj" => Some(obj_files(input)),
        _ => None,
    };
    found.unwrap_or_default()
}

fn extension(path: &Path) -> String {
    let extension = path.extension().unwrap_or_default();
    extension.to_string_lossy().to_ascii_lowercase()
}

fn glb_json(mut file: File) -> Option<impl Read> {
    // Twelve bytes of header, then the JSON chunk: its length, its type, its text.
    let mut head = [0; 20];
    file.read_exact(&mut head).ok()?;
    let length = u32::from_le_bytes([head[12], head[13], head[14], head[15]]);
    Some(file.take(u64::from(length)))
}

fn gltf_uris(json: impl Read) -> Option<BTreeSet<String>> {
    let document: serde_json::Value = serde_json::from_reader(BufReader::new(json)).ok()?;
    let lists = ["buffers", "images"]
        .into_iter()
        .filter_map(|name| document[name].as_array());
    let uris = lists.flatten().filter_map(|entry| entry["uri"].as_str());
    Some(
        uris.filter(|uri| !uri.starts_with("data:"))
            .map(percent_decoded)
            .collect(),
    )
}

fn percent_decoded(uri: &str) -> String {
    let mut bytes = Vec::new();
    let mut rest = uri.as_bytes();
    while let [first, tail @ ..] = rest {
        let code = tail.get(..2).and_then(|digits| std::str::from_utf8(digits).ok());
        match code.and_then(|digits| u8::from_str_radix(digits, 16).ok()) {
            Some(byte) if *first == b'%' => {
                bytes.push(byte);
                rest = &tail[2..];
            }
            _ => {
                bytes.push(*first);
                rest = tail;
            }
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

/// Material libraries of an OBJ file, and the textures those name.
fn obj_files(input: &Path) -> BTreeSet<String> {
    let folder = input.parent().unwrap_or(Path::new("/"));
    let libraries = arguments(input, |word| word == "mtllib");
    let mut files: BTreeSet<String> = libraries.iter().cloned().collect();
    for library in &libraries {
        let textures = arguments(&folder.join(library), |word| word.starts_with("map_"));
        // Options may stand before the name; the name is last.
        files.extend(
            textures
                .iter()
                .filter_map(|text| text.split_whitespace().last())
                .map(str::to_owned),
        );
    }
    files
}

/// What follows a keyword on the lines of a text file.
fn arguments(path: &Path, keyword: impl Fn(&str) -> bool) -> Vec<String> {
    let Ok(file) = File::open(path) else { return Vec::new() };
    let lines = BufReader::new(file).split(b'\n').map_while(Result::ok);
    lines
        .filter_map(|line| {
            let line = String::from_utf8_lossy(&line);
            let (word, rest) = line.trim().split_once(char::is_whitespace)?;
            keyword(word).then(|| rest.trim().to_owned())
        })
        .collect()
}

/// FNV-1a of 128 bits over words of eight bytes: tells contents apart, guards against no one.
struct Digest(u128);

impl Digest {
    const PRIME: u128 = 0x0000_0000_0100_0000_0000_0000_0000_013b;
    const START: u128 = 0x6c62_272e_07bb_0142_62b8_2175_6295_c58d;

    fn new() -> Self {
        Self(Self::START)
    }

    fn text(&mut self, text: &str) {
        self.bytes(text.as_bytes());
        self.word(text.len() as u64);
    }

    fn file(&mut self, mut file: File) -> io::Result<()> {
        const BUFFER_BYTES: usize = 1 << 18;
        let mut buffer = vec![0; BUFFER_BYTES];
        let mut length = 0;
        loop {
            // Whole buffers, so that words do not depend on how the system cuts its answers.
            let mut filled = 0;
            while filled < buffer.len() {
                match file.read(&mut buffer[filled..])? {
                    0 => break,
                    count => filled += count,
                }
            }
            self.bytes(&buffer[..filled]);
            length += filled as u64;
            if filled < buffer.len() {
                self.word(length);
                return Ok(());
            }
        }
    }

    fn bytes(&mut self, bytes: &[u8]) {
        for chunk in bytes.chunks(8) {
            let mut word = [0; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            self.word(u64::from_le_bytes(word));
        }
    }

    fn word(&mut self, word: u64) {
        self.0 = (self.0 ^ u128::from(word)).wrapping_mul(Self::PRIME);
        // The multiplication carries upwards only; this brings the high bits back down.
        self.0 ^= self.0 >> 64;
    }
}

fn fault(action: &str, path: &Path, error: &io::Error) -> Failure {
    Failure::failed(format!("cannot {action} {path:?}: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn digest_of(path: &Path) -> String {
        digest(path, Density::Points(10)).unwrap()
    }

    #[test]
    fn the_digest_follows_the_content_and_the_density() {
        let folder = tempfile::tempdir().unwrap();
        let (a, b) = (folder.path().join("a.glb"), folder.path().join("b.glb"));
        fs::write(&a, "same").unwrap();
        fs::write(&b, "same").unwrap();
        assert_eq!(digest_of(&a), digest_of(&b));
        assert_ne!(digest_of(&a), digest(&a, Density::Points(11)).unwrap());
        assert_ne!(digest_of(&a), digest(&a, Density::Spacing(10.0)).unwrap());
        fs::write(&b, "same\0").unwrap();
        assert_ne!(digest_of(&a), digest_of(&b));
    }

    #[test]
    fn the_digest_follows_the_files_that_a_mesh_names() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let gltf = root.join("a.gltf");
        let text = r#"{"buffers":[{"uri":"my%20mesh.bin"},{"uri":"data:,x"}],"images":[{"uri":"t.png"}]}"#;
        fs::write(&gltf, text).unwrap();
        let expected: BTreeSet<String> = ["my mesh.bin", "t.png"].map(str::to_owned).into();
        assert_eq!(named_files(&gltf), expected);
        let before = digest_of(&gltf);
        fs::write(root.join("my mesh.bin"), "1").unwrap();
        let with = digest_of(&gltf);
        assert_ne!(before, with);
        fs::write(root.join("my mesh.bin"), "2").unwrap();
        assert_ne!(with, digest_of(&gltf));

        let obj = root.join("a.obj");
        fs::write(&obj, "mtllib a.mtl\nv 0 0 0\n").unwrap();
        fs::write(root.join("a.mtl"), "newmtl m\n  map_Kd -s 2 2 2 wood.png\n").unwrap();
        let expected: BTreeSet<String> = ["a.mtl", "wood.png"].map(str::to_owned).into();
        assert_eq!(named_files(&obj), expected);
    }

    #[tokio::test]
    async fn the_least_recently_used_scenes_go() {
        let folder = tempfile::tempdir().unwrap();
        let cache = SceneCache::open(folder.path()).unwrap();
        for index in 0..SCENES_KEPT + 2 {
            let kept = cache.keep(&index.to_string()).await.unwrap();
            fs::create_dir(&kept.scene).unwrap();
            kept.mark(Path::new("/a.glb"));
            let when = std::time::SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(index as u64);
            File::options()
                .write(true)
                .open(&kept.note)
                .unwrap()
                .set_modified(when)
                .unwrap();
        }
        cache.trim();
        let there = |index: usize| fs::metadata(folder.path().join(format!("scenes/{index}.pbgi"))).is_ok();
        assert!(!there(0) && !there(1) && there(2) && there(SCENES_KEPT + 1));
    }
}
