//! Paths from the command line: made absolute, symbolic links resolved, checked before any work is done.

use super::failure::Failure;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Whether a path is one that a shared daemon understands, `ROOT:path`, and not a file here.
pub(crate) fn in_a_root(path: &Path) -> bool {
    let root = path
        .to_str()
        .and_then(|text| text.split_once(':'))
        .map(|(root, _)| root);
    let named = |root: &str| {
        !root.is_empty()
            && root
                .bytes()
                .all(|byte| byte.is_ascii_alphanumeric() || b"_-".contains(&byte))
    };
    root.is_some_and(named) && fs::symlink_metadata(path).is_err()
}

/// An input file or folder that is there.
pub(crate) fn input(path: &Path) -> Result<PathBuf, Failure> {
    if in_a_root(path) {
        return Ok(path.to_owned());
    }
    path.canonicalize().map_err(|error| match error.kind() {
        io::ErrorKind::NotFound => Failure::failed(format!(
            "there is no {path:?}; check the path (the current folder is {})",
            here()
        )),
        _ => Failure::failed(format!("cannot open {path:?}: {error}")),
    })
}

/// Several inputs.
pub(crate) fn inputs(paths: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    paths.iter().map(|path| input(path)).collect()
}

/// An input that is there, or that a job before this one makes: then its folder is there.
pub(crate) fn input_to_come(path: &Path) -> Result<PathBuf, Failure> {
    let there = input(path);
    match (path.parent(), path.file_name()) {
        (Some(folder), Some(name)) if there.is_err() && fs::symlink_metadata(path).is_err() => {
            let here = folder.as_os_str().is_empty();
            Ok(input(if here { Path::new(".") } else { folder })?.join(name))
        }
        _ => there,
    }
}

/// What happens to an output that is there already.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Existing {
    Refuse,
    Replace,
}

impl Existing {
    pub(crate) fn from_flag(overwrite: bool) -> Self {
        if overwrite { Self::Replace } else { Self::Refuse }
    }

    pub(crate) fn replaces(self) -> bool {
        self == Self::Replace
    }
}

/// A place to write to: its folder is there, and nothing is in the way.
pub(crate) fn output(path: &Path, existing: Existing) -> Result<PathBuf, Failure> {
    let Some(name) = path.file_name() else {
        return Err(Failure::usage(format!("output {path:?} has no file name")));
    };
    if in_a_root(path) {
        return Ok(path.to_owned());
    }
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let folder = folder.canonicalize().map_err(|error| match error.kind() {
        io::ErrorKind::NotFound => Failure::failed(format!(
            "cannot write {path:?}: there is no folder {folder:?}; make it first"
        )),
        _ => Failure::failed(format!("cannot write {path:?}: {error}")),
    })?;
    let target = folder.join(name);
    match fs::symlink_metadata(&target) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(target),
        Err(error) => Err(Failure::failed(format!("cannot write {path:?}: {error}"))),
        Ok(_) if existing == Existing::Refuse => Err(Failure::failed(format!(
            "{path:?} is there already; add --overwrite to replace it, or choose another name with -o"
        ))),
        // A dangling link stays what it is: it is replaced.
        Ok(_) => Ok(target.canonicalize().unwrap_or(target)),
    }
}

/// As [`output`], with one of the extensions that say how it is written.
pub(crate) fn output_of_kind(path: &Path, existing: Existing, kind: &str) -> Result<PathBuf, Failure> {
    let extension = path
        .extension()
        .unwrap_or_default()
        .to_string_lossy()
        .to_ascii_lowercase();
    if extension != kind {
        return Err(Failure::usage(format!("output {path:?} must end in .{kind}")));
    }
    output(path, existing)
}

/// Writes a small file in one step: whoever reads it sees all of it or the old one.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    let failed = |error: io::Error| Failure::failed(format!("cannot write {path:?}: {error}"));
    let target = output(path, Existing::Replace)?;
    let folder = target.parent().unwrap_or(Path::new("/"));
    let mut file = tempfile::Builder::new()
        .prefix(".pbgi-")
        .permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666))
        .tempfile_in(folder)
        .map_err(failed)?;
    file.write_all(bytes).map_err(failed)?;
    file.persist(&target).map_err(|error| failed(error.error))?;
    Ok(())
}

fn here() -> String {
    let folder = std::env::current_dir();
    folder.map_or_else(|_| "unknown".to_owned(), |folder| folder.display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_in_roots_are_left_to_the_daemon() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(
            input(Path::new("scenes:a/b.pbgi")).unwrap(),
            Path::new("scenes:a/b.pbgi")
        );
        assert_eq!(
            output(Path::new("out:b.exr"), Existing::Refuse).unwrap(),
            Path::new("out:b.exr")
        );
        let here = folder.path().join("odd:name");
        fs::write(&here, "").unwrap();
        assert_eq!(input(&here).unwrap(), here.canonicalize().unwrap());
        assert!(input(Path::new("./none:there")).is_err());
    }

    #[test]
    fn scene_that_an_earlier_job_makes_need_not_be_there_but_its_folder_must() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().canonicalize().unwrap();
        assert_eq!(input_to_come(&root.join("s.pbgi")).unwrap(), root.join("s.pbgi"));
        assert!(input_to_come(Path::new("s.pbgi")).unwrap().is_absolute());
        assert!(input_to_come(&root.join("none/s.pbgi")).is_err());
        fs::write(root.join("s.pbgi"), "").unwrap();
        assert_eq!(input_to_come(&root.join("s.pbgi")).unwrap(), root.join("s.pbgi"));
    }

    #[test]
    fn paths_become_absolute_and_links_are_resolved() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().canonicalize().unwrap();
        fs::create_dir(root.join("real")).unwrap();
        std::os::unix::fs::symlink(root.join("real"), root.join("link")).unwrap();
        fs::write(root.join("real/a.ply"), "x").unwrap();
        assert_eq!(input(&root.join("link/a.ply")).unwrap(), root.join("real/a.ply"));
        let out = output(&root.join("link/b.exr"), Existing::Refuse).unwrap();
        assert_eq!(out, root.join("real/b.exr"));
    }

    #[test]
    fn what_is_missing_or_in_the_way_is_named_with_the_remedy() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.exr");
        let text = input(&file).unwrap_err().to_string();
        assert!(text.contains("there is no") && text.contains("a.exr"), "{text}");
        fs::write(&file, "x").unwrap();
        let text = output(&file, Existing::Refuse).unwrap_err().to_string();
        assert!(text.contains("--overwrite"), "{text}");
        assert!(output(&file, Existing::Replace).is_ok());
        let text = output(&folder.path().join("no/b.exr"), Existing::Refuse)
            .unwrap_err()
            .to_string();
        assert!(text.contains("make it first"), "{text}");
        let failure = output_of_kind(&folder.path().join("b.jpg"), Existing::Refuse, "exr").unwrap_err();
        assert!(matches!(failure, Failure::Usage(_)));
    }

    #[test]
    fn a_small_file_is_replaced_whole() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.json");
        write_whole(&file, b"long text").unwrap();
        write_whole(&file, b"new").unwrap();
        assert_eq!(fs::read(&file).unwrap(), b"new");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
