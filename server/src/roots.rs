//! Which files a client can make the daemon touch.
//!
//! Without roots, jobs name absolute paths, and only our own user may call: it can do nothing that it could not do itself. With
//! roots, jobs name `ROOT:relative/path`. The kernel resolves such a path below its root, without links (`openat2`), and what is
//! used afterwards is the opened descriptor, by its name in /proc, so that nothing can be swapped in between. Errors for clients
//! name paths as clients do.

use crate::access::Root;
use crate::error::{JobError, JobErrorKind, ServerError};
use crate::limits;
use nix::errno::Errno;
use nix::fcntl::{OFlag, OpenHow, ResolveFlag, open, openat2};
use nix::sys::stat::{Mode, SFlag, fstat};
use std::collections::BTreeMap;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::{Component, Path, PathBuf};

/// The roots, opened.
#[derive(Debug, Default)]
pub struct Roots {
    roots: BTreeMap<String, (Root, OwnedFd)>,
}

/// A file or folder that may be used as asked for, while this lives.
#[derive(Debug)]
pub struct Place {
    /// How to open it.
    pub path: PathBuf,
    /// What the client called it.
    shown: PathBuf,
    /// The root's real path and name, for the errors of those who see through `path`.
    root: Option<(PathBuf, String)>,
    _held: Option<OwnedFd>,
}

impl Place {
    /// An error's text with paths as the client knows them.
    pub fn hide(&self, text: &str) -> String {
        let text = text.replace(&*self.path.to_string_lossy(), &self.shown.to_string_lossy());
        match &self.root {
            None => text,
            Some((real, name)) => {
                let real = real.to_string_lossy();
                text.replace(&format!("{}/", real.trim_end_matches('/')), &format!("{name}:"))
            }
        }
    }
}

impl Roots {
    /// Opens the roots of a configuration.
    ///
    /// # Errors
    /// A line for each that is no directory, or a kernel without `openat2`.
    pub fn open(roots: &BTreeMap<String, Root>) -> Result<Self, ServerError> {
        let (mut opened, mut problems) = (BTreeMap::new(), Vec::new());
        for (name, root) in roots {
            let flags = OFlag::O_PATH | OFlag::O_DIRECTORY | OFlag::O_CLOEXEC;
            let directory = open(&root.path, flags, Mode::empty()).and_then(|directory| {
                resolve(&directory, Path::new("."), OFlag::O_PATH)?;
                Ok(directory)
            });
            match directory {
                Ok(directory) => {
                    opened.insert(name.clone(), (root.clone(), directory));
                }
                Err(Errno::ENOSYS) => {
                    problems.push("this kernel has no openat2 (Linux 5.6), which roots need".to_owned())
                }
                Err(errno) => problems.push(format!("cannot open roots.{name}: {errno}, at {}", root.path.display())),
            }
        }
        if problems.is_empty() {
            Ok(Self { roots: opened })
        } else {
            Err(ServerError::Configuration(problems))
        }
    }

    /// Whether there are none: jobs name absolute paths.
    pub fn is_empty(&self) -> bool {
        self.roots.is_empty()
    }

    /// Checks a path that a client names, before anything is opened.
    ///
    /// # Errors
    /// [`JobErrorKind::Invalid`], or [`JobErrorKind::Denied`] for a root that does not grant what is wanted.
    pub fn check(&self, field: &str, path: &Path, want: Want) -> Result<(), JobError> {
        let bytes = path.as_os_str().as_encoded_bytes();
        let wrong = if bytes.is_empty() {
            "is empty"
        } else if bytes.contains(&0) {
            "has a zero byte"
        } else if bytes.len() > limits::PATH_BYTES_MAX {
            "is too long"
        } else if self.is_empty() && !path.is_absolute() {
            "is not absolute"
        } else if path.file_name().is_none() {
            "names no file"
        } else if self.is_empty() {
            return Ok(());
        } else {
            return self.find(path, want).map(|_| ()).map_err(|error| JobError {
                text: format!("{field} path {}", error.text),
                ..error
            });
        };
        Err(JobError::invalid(format!("{field} path {wrong}: {}", path.display())))
    }

    /// A file or folder to read.
    ///
    /// # Errors
    /// It is not there, is neither file nor folder, or may not be read.
    pub fn read(&self, path: &Path) -> Result<Place, JobError> {
        if self.is_empty() {
            return Ok(plain(path));
        }
        let (root, directory, name, relative) = self.find(path, Want::Read)?;
        // O_NONBLOCK: opening a FIFO must not wait for its writer.
        let flags = OFlag::O_RDONLY | OFlag::O_NONBLOCK | OFlag::O_NOFOLLOW | OFlag::O_NOCTTY;
        let file = resolve(directory, relative, flags).map_err(|errno| refused(errno, path))?;
        let kind = fstat(&file).map(|stat| SFlag::from_bits_truncate(stat.st_mode) & SFlag::S_IFMT);
        if !matches!(kind, Ok(SFlag::S_IFREG | SFlag::S_IFDIR)) {
            let text = format!("is neither a file nor a folder: {}", path.display());
            return Err(JobError::new(JobErrorKind::Denied, text));
        }
        Ok(Place {
            path: format!("/proc/self/fd/{}", file.as_raw_fd()).into(),
            shown: path.to_owned(),
            root: Some((root.path.clone(), name.to_owned())),
            _held: Some(file),
        })
    }

    /// A new file, or one to be replaced, in a folder that is there.
    ///
    /// # Errors
    /// The folder is not there, or may not be written to.
    pub fn write(&self, path: &Path, overwrite: bool) -> Result<Place, JobError> {
        if self.is_empty() {
            return Ok(plain(path));
        }
        let want = Want::output(overwrite);
        let (root, directory, name, relative) = self.find(path, want)?;
        let (Some(folder), Some(file)) = (relative.parent(), relative.file_name()) else {
            return Err(JobError::invalid(format!("names no file: {}", path.display())));
        };
        let folder = if folder.as_os_str().is_empty() {
            Path::new(".")
        } else {
            folder
        };
        let flags = OFlag::O_RDONLY | OFlag::O_DIRECTORY;
        let folder = resolve(directory, folder, flags).map_err(|errno| refused(errno, path))?;
        Ok(Place {
            path: Path::new(&format!("/proc/self/fd/{}", folder.as_raw_fd())).join(file),
            shown: path.to_owned(),
            root: Some((root.path.clone(), name.to_owned())),
            _held: Some(folder),
        })
    }

    /// The real path, for a build child, which is confined to it by other means.
    ///
    /// # Errors
    /// As [`Self::read`] and [`Self::write`].
    pub fn real(&self, path: &Path, want: Want) -> Result<PathBuf, JobError> {
        if self.is_empty() {
            return Ok(path.to_owned());
        }
        let place = match want {
            Want::Read => self.read(path)?,
            Want::Write => self.write(path, false)?,
            Want::Overwrite => self.write(path, true)?,
        };
        drop(place);
        let (root, _, _, relative) = self.find(path, want)?;
        Ok(root.path.join(relative))
    }

    /// The real path of a root that a client's path is in; `None` without roots.
    pub fn root_of(&self, path: &Path) -> Option<(PathBuf, String)> {
        let name = path.to_str()?.split_once(':')?.0;
        let (root, _) = self.roots.get(name)?;
        Some((root.path.clone(), name.to_owned()))
    }

    fn find<'a>(&'a self, path: &'a Path, want: Want) -> Result<(&'a Root, &'a OwnedFd, &'a str, &'a Path), JobError> {
        let shown = path.display();
        let names = || self.roots.keys().cloned().collect::<Vec<_>>().join(", ");
        let split = path.to_str().and_then(|path| path.split_once(':'));
        let Some((name, relative)) = split else {
            let text = format!("must look like ROOT:path with a root out of {}: {shown}", names());
            return Err(JobError::invalid(text));
        };
        let Some((root, directory)) = self.roots.get(name) else {
            let text = format!("has no root {name:?}, only {}: {shown}", names());
            return Err(JobError::invalid(text));
        };
        let relative = Path::new(relative);
        let plain = |part: Component<'_>| matches!(part, Component::Normal(_));
        let parts = relative.components().count();
        if parts == 0 || parts > limits::PATH_PARTS_MAX || !relative.components().all(plain) {
            let text = format!("must stay below its root, without . and .. and a leading /: {shown}");
            return Err(JobError::invalid(text));
        }
        let granted = match want {
            Want::Read => root.read,
            Want::Write => root.write,
            Want::Overwrite => root.write && root.overwrite,
        };
        if !granted {
            let what = match want {
                Want::Read => "read",
                Want::Write => "written to",
                Want::Overwrite => "overwritten in",
            };
            let text = format!("is in root {name:?}, which may not be {what}: {shown}");
            return Err(JobError::new(JobErrorKind::Denied, text));
        }
        Ok((root, directory, name, relative))
    }
}

/// What is to be done with a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Want {
    /// Read it.
    Read,
    /// Make it.
    Write,
    /// Make it in place of what is there.
    Overwrite,
}

impl Want {
    /// What a job wants with its output.
    pub fn output(overwrite: bool) -> Self {
        if overwrite { Self::Overwrite } else { Self::Write }
    }
}

fn plain(path: &Path) -> Place {
    Place {
        path: path.to_owned(),
        shown: path.to_owned(),
        root: None,
        _held: None,
    }
}

fn resolve(directory: &OwnedFd, path: &Path, flags: OFlag) -> nix::Result<OwnedFd> {
    let how = OpenHow::new()
        .flags(flags | OFlag::O_CLOEXEC)
        .resolve(ResolveFlag::RESOLVE_BENEATH | ResolveFlag::RESOLVE_NO_MAGICLINKS | ResolveFlag::RESOLVE_NO_SYMLINKS);
    openat2(directory, path, how)
}

fn refused(errno: Errno, path: &Path) -> JobError {
    let kind = match errno {
        Errno::ENOENT | Errno::ENOTDIR => JobErrorKind::NotFound,
        Errno::ELOOP | Errno::EXDEV | Errno::EACCES | Errno::EPERM | Errno::ENXIO => JobErrorKind::Denied,
        _ => JobErrorKind::Precondition,
    };
    let why = match errno {
        Errno::ELOOP => "symbolic links are not followed",
        Errno::EXDEV => "it leads out of its root",
        other => other.desc(),
    };
    JobError::new(kind, format!("cannot open: {why}, at {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::symlink;

    fn roots(folder: &Path) -> Roots {
        let root = |path: &str, read, write, overwrite| Root {
            path: folder.join(path),
            read,
            write,
            overwrite,
        };
        for name in ["in/deep", "out", "secret"] {
            fs::create_dir_all(folder.join(name)).unwrap();
        }
        fs::write(folder.join("in/a.exr"), "a").unwrap();
        fs::write(folder.join("in/deep/b.exr"), "b").unwrap();
        fs::write(folder.join("secret/s"), "s").unwrap();
        let named = [
            ("in", root("in", true, false, false)),
            ("out", root("out", false, true, false)),
        ];
        Roots::open(&named.map(|(name, root)| (name.to_owned(), root)).into()).unwrap()
    }

    #[test]
    fn what_is_granted_can_be_opened() {
        let folder = tempfile::tempdir().unwrap();
        let roots = roots(folder.path());
        for (name, text) in [("in:a.exr", "a"), ("in:deep/b.exr", "b")] {
            let place = roots.read(Path::new(name)).unwrap();
            assert_eq!(fs::read_to_string(&place.path).unwrap(), text);
            let told = place.hide(&format!("bad file at {}", place.path.display()));
            assert_eq!(told, format!("bad file at {name}"));
        }
        let place = roots.write(Path::new("out:new.exr"), false).unwrap();
        fs::write(&place.path, "new").unwrap();
        assert_eq!(fs::read_to_string(folder.path().join("out/new.exr")).unwrap(), "new");
    }

    #[test]
    fn no_escape_opens_anything_outside() {
        let folder = tempfile::tempdir().unwrap();
        let roots = roots(folder.path());
        let inside = folder.path().join("in");
        symlink("../secret/s", inside.join("file-link")).unwrap();
        symlink(folder.path().join("secret"), inside.join("dir-link")).unwrap();
        symlink("/proc/self/root", inside.join("magic")).unwrap();
        symlink("loop", inside.join("loop")).unwrap();
        nix::unistd::mkfifo(&inside.join("fifo"), Mode::S_IRWXU).unwrap();
        let _socket = std::os::unix::net::UnixListener::bind(inside.join("socket")).unwrap();
        let long = format!("in:{}", "x/".repeat(40));
        let names = [
            "in:../secret/s",
            "in:deep/../../secret/s",
            "in:/etc/passwd",
            "/etc/passwd",
            "in:",
            "in:.",
            "in:./a.exr/..",
            "in:file-link",
            "in:dir-link/s",
            "in:dir-link",
            "in:magic/etc/passwd",
            "in:loop",
            "in:fifo",
            "in:socket",
            "in:nothing",
            "in:a.exr/below",
            "secret:s",
            "a.exr",
            "IN:a.exr",
            ":a.exr",
            "in::a.exr",
            "out:x",
            "in:deep/..",
            "in:..",
            "in:~/x",
            "in:%2e%2e/secret/s",
            "in:..%2fsecret",
            "in:\u{0}",
            "in:a.exr\u{0}b",
            "../in:a.exr",
            "in:deep/./../a.exr/..",
            "in:magic",
            "in:magic/proc/self/root",
            "file:///etc/passwd",
            "in:file-link/.",
            "in:deep//../../secret/s",
            "in:../../../../../../etc/passwd",
            "/proc/self/root",
            "in:dir-link/../a.exr",
            long.as_str(),
        ];
        for name in names {
            assert!(roots.read(Path::new(name)).is_err(), "{name:?} was opened");
        }
        for name in [
            "in:new",
            "out:../secret/new",
            "out:none/new",
            "/tmp/new",
            "out:/tmp/new",
        ] {
            assert!(roots.write(Path::new(name), false).is_err(), "{name:?} was granted");
        }
        assert!(
            roots.write(Path::new("out:new"), true).is_err(),
            "overwrite was granted"
        );
        println!(
            "RELIABILITY paths: {} escapes, {} refusals, 0 opens outside",
            names.len(),
            names.len()
        );
    }

    #[test]
    fn file_that_is_swapped_for_a_link_never_leads_outside() {
        let folder = tempfile::tempdir().unwrap();
        let roots = roots(folder.path());
        let inside = folder.path().join("in");
        let stop = std::sync::atomic::AtomicBool::new(false);
        let mut opened = 0;
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                    let (file, link) = (inside.join("tmp-file"), inside.join("tmp-link"));
                    fs::write(&file, "a").unwrap();
                    fs::rename(&file, inside.join("a.exr")).unwrap();
                    symlink("../secret/s", &link).unwrap();
                    fs::rename(&link, inside.join("a.exr")).unwrap();
                }
            });
            for _ in 0..10_000 {
                if let Ok(place) = roots.read(Path::new("in:a.exr")) {
                    opened += 1;
                    assert_ne!(fs::read_to_string(&place.path).unwrap(), "s");
                }
            }
            stop.store(true, std::sync::atomic::Ordering::Relaxed);
        });
        println!("RELIABILITY paths-race: 10,000 opens against a swap, {opened} of the file, 0 of what the link names");
    }

    #[test]
    fn missing_root_is_named() {
        let root = Root {
            path: "/nowhere/at/all".into(),
            read: true,
            write: false,
            overwrite: false,
        };
        let error = Roots::open(&[("a".to_owned(), root)].into()).unwrap_err();
        assert!(error.to_string().contains("roots.a"), "{error}");
    }
}
