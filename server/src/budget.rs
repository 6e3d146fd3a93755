//! One number for all memory: how it is chosen, checked against the machine, and divided.
//!
//! ```text
//! |<----------------------------------- --memory ----------------------------------->|
//! | daemon | workers x reserve | segment: pages, tables, ledgers | work: builds, pictures |
//! ```
//! A build gets half of the work share; a shading job takes what its picture needs, and waits while that is not free.

use crate::error::ServerError;
use crate::limits;
use pbgi_core::limits::MEMORY_DEFAULT_BYTES;
use std::fs;
use std::path::{Path, PathBuf};

/// What the machine has to give.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Machine {
    /// Free bytes in /dev/shm.
    pub shared_free_bytes: u64,
    /// The tightest memory limit of the control groups that this process is in.
    pub limit_bytes: Option<u64>,
}

impl Machine {
    /// Asks the system.
    ///
    /// # Errors
    /// No /dev/shm.
    pub fn probe() -> Result<Self, ServerError> {
        let shm = Path::new("/dev/shm");
        let stat = nix::sys::statvfs::statvfs(shm)
            .map_err(|errno| ServerError::io("inspect shared memory", shm)(errno.into()))?;
        Ok(Self {
            shared_free_bytes: stat.blocks_available() as u64 * stat.fragment_size() as u64,
            limit_bytes: cgroup_limit(Path::new("/proc/self/cgroup"), Path::new("/sys/fs/cgroup")),
        })
    }

    fn limit_share(&self) -> Option<u64> {
        self.limit_bytes
            .map(|bytes| (bytes as f64 * limits::LIMIT_SHARE) as u64)
    }
}

/// How the memory is divided.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryPlan {
    /// All of it.
    pub total_bytes: u64,
    /// The shared segment, at most.
    pub segment_bytes: u64,
    /// Builds and pictures.
    pub work_bytes: u64,
    /// One build, out of the work share.
    pub build_bytes: u64,
}

impl MemoryPlan {
    /// Chooses or checks the total and divides it.
    ///
    /// # Errors
    /// [`ServerError::Memory`] with what is needed and what there is.
    pub fn new(requested: Option<u64>, workers: u32, machine: &Machine) -> Result<Self, ServerError> {
        let total = requested.unwrap_or_else(|| {
            let shared = (machine.shared_free_bytes as f64 * limits::LIMIT_SHARE) as u64;
            let limit = machine.limit_share().unwrap_or(u64::MAX);
            MEMORY_DEFAULT_BYTES.min(shared).min(limit)
        });
        if let Some(available) = machine.limit_share().filter(|&available| total > available) {
            return Err(ServerError::Memory {
                what: "memory in this control group (four fifths of its limit are used)",
                needed: total,
                available,
                remedy: "give a smaller --memory or raise the limit".into(),
            });
        }
        let fixed = limits::DAEMON_RESERVE_BYTES + u64::from(workers) * limits::WORKER_RESERVE_BYTES;
        if total <= fixed {
            return Err(ServerError::Memory {
                what: "memory",
                needed: fixed,
                available: total,
                remedy: format!("give a larger --memory or fewer than {workers} --workers"),
            });
        }
        let shared = ((total - fixed) as f64 * limits::SEGMENT_SHARE) as u64;
        // A small budget lends pages to builds, as long as that leaves the better half of it.
        let builds = total - fixed - limits::BUILD_BYTES_MIN.min((total - fixed) / 2);
        let segment_bytes = shared.min(builds);
        if segment_bytes > machine.shared_free_bytes {
            return Err(ServerError::Memory {
                what: "shared memory in /dev/shm",
                needed: segment_bytes,
                available: machine.shared_free_bytes,
                remedy: "give a smaller --memory or enlarge /dev/shm".into(),
            });
        }
        let work_bytes = total - fixed - segment_bytes;
        Ok(Self {
            total_bytes: total,
            segment_bytes,
            work_bytes,
            build_bytes: (work_bytes / 2).max(limits::BUILD_BYTES_MIN.min(work_bytes)),
        })
    }
}

/// Reads a size: a number of bytes, with K, M, G or T (powers of 1,024) if wanted.
///
/// # Errors
/// A text for people.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let wrong = || format!("{text:?} is no size; write for example 512M or 2G");
    let lower = text.trim().to_ascii_lowercase();
    let lower = lower.strip_suffix("ib").or(lower.strip_suffix('b')).unwrap_or(&lower);
    let unit = lower
        .bytes()
        .last()
        .and_then(|last| b"kmgt".iter().position(|&unit| unit == last));
    let (digits, shift) = match unit {
        Some(unit) => (&lower[..lower.len() - 1], 10 * (unit as i32 + 1)),
        None => (lower, 0),
    };
    let number: f64 = digits.parse().map_err(|_| wrong())?;
    let bytes = number * 2f64.powi(shift);
    if bytes >= 1.0 && bytes < 2f64.powi(63) {
        Ok(bytes as u64)
    } else {
        Err(wrong())
    }
}

/// The smallest limit on the way from this process's group to the root; versions 1 and 2.
fn cgroup_limit(membership: &Path, root: &Path) -> Option<u64> {
    let text = fs::read_to_string(membership).ok()?;
    let limits = text.lines().flat_map(|line| {
        let mut fields = line.splitn(3, ':');
        let (_, controllers, group) = (fields.next(), fields.next().unwrap_or(""), fields.next().unwrap_or(""));
        let (base, file) = match controllers {
            "" => (root.to_owned(), "memory.max"),
            "memory" => (root.join("memory"), "memory.limit_in_bytes"),
            _ => return Vec::new(),
        };
        let group = PathBuf::from(group.trim_start_matches('/'));
        let limit = |group: &Path| {
            fs::read_to_string(base.join(group).join(file))
                .ok()?
                .trim()
                .parse::<u64>()
                .ok()
        };
        group.ancestors().filter_map(limit).collect()
    });
    // Version 1 writes a number near 2^63 for no limit.
    limits.filter(|&bytes| bytes < 1 << 60).min()
}

#[cfg(test)]
mod tests {
    use super::*;

    const G: u64 = 1 << 30;

    #[test]
    fn sizes_are_read_with_their_units() {
        for (text, bytes) in [
            ("2G", 2 * G),
            ("512M", G / 2),
            ("1.5g", 3 * G / 2),
            ("64KiB", 65_536),
            ("1000", 1000),
            ("1tb", 1024 * G),
        ] {
            assert_eq!(parse_bytes(text), Ok(bytes), "{text}");
        }
        for text in ["", "G", "-1G", "many", "0", "nan", "1e300", "2 G x"] {
            assert!(parse_bytes(text).is_err(), "{text}");
        }
    }

    #[test]
    fn default_is_the_smallest_of_two_gigabytes_and_four_fifths_of_the_limits() {
        let plan = |shared, limit| {
            let machine = Machine {
                shared_free_bytes: shared,
                limit_bytes: limit,
            };
            MemoryPlan::new(None, 2, &machine).unwrap().total_bytes
        };
        assert_eq!(plan(100 * G, None), 2 * G);
        assert_eq!(plan(G, None), (0.8 * G as f64) as u64);
        assert_eq!(plan(100 * G, Some(G)), (0.8 * G as f64) as u64);
    }

    #[test]
    fn explicit_memory_that_does_not_fit_is_refused_with_both_numbers() {
        let machine = |shared, limit| Machine {
            shared_free_bytes: shared,
            limit_bytes: limit,
        };
        let cases = [
            (2 * G, machine(G / 2, None), "/dev/shm"),
            (2 * G, machine(100 * G, Some(2 * G)), "control group"),
            (16 << 20, machine(100 * G, None), "not enough memory: "),
        ];
        for (requested, machine, word) in cases {
            let error = MemoryPlan::new(Some(requested), 2, &machine).unwrap_err();
            assert_eq!(error.exit_code(), 78);
            assert!(error.to_string().contains(word), "{error}");
        }
    }

    #[test]
    fn default_budget_holds_a_picture_of_four_thousand_columns() {
        let machine = Machine {
            shared_free_bytes: 100 * G,
            limit_bytes: None,
        };
        let plan = MemoryPlan::new(None, 8, &machine).unwrap();
        assert!(plan.work_bytes >= 3840 * 2160 * limits::PICTURE_BYTES_PER_PIXEL);
    }

    #[test]
    fn parts_add_up_to_the_total() {
        let machine = Machine {
            shared_free_bytes: 100 * G,
            limit_bytes: None,
        };
        for workers in [1, 7, 64] {
            let plan = MemoryPlan::new(Some(2 * G), workers, &machine).unwrap();
            let fixed = limits::DAEMON_RESERVE_BYTES + u64::from(workers) * limits::WORKER_RESERVE_BYTES;
            assert_eq!(plan.segment_bytes + plan.work_bytes + fixed, plan.total_bytes);
            assert!(plan.build_bytes <= plan.work_bytes && plan.build_bytes >= limits::BUILD_BYTES_MIN);
        }
    }

    #[test]
    fn the_tightest_group_on_the_way_to_the_root_counts() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("fs");
        fs::create_dir_all(root.join("a/b")).unwrap();
        fs::create_dir_all(root.join("memory/old")).unwrap();
        let membership = folder.path().join("cgroup");
        let check = |text: &str, expected| {
            fs::write(&membership, text).unwrap();
            assert_eq!(cgroup_limit(&membership, &root), expected, "{text}");
        };
        check("0::/a/b\n", None);
        fs::write(root.join("a/b/memory.max"), "max\n").unwrap();
        check("0::/a/b\n", None);
        fs::write(root.join("a/memory.max"), "1073741824\n").unwrap();
        check("0::/a/b\n", Some(G));
        fs::write(root.join("a/b/memory.max"), "536870912\n").unwrap();
        check("0::/a/b\n", Some(G / 2));
        fs::write(root.join("memory/old/memory.limit_in_bytes"), "2147483648").unwrap();
        check("7:cpu:/old\n4:memory:/old\n0::/\n", Some(2 * G));
        fs::write(root.join("memory/old/memory.limit_in_bytes"), "9223372036854771712").unwrap();
        check("4:memory:/old\n", None);
    }
}
