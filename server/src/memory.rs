//! How much private memory the processes of this daemon have: its own, its workers', its build child's.

use std::fs;

/// Anonymous resident bytes of a process; `None` if it is gone. Shared memory and mapped files do not count.
pub fn anonymous_bytes(pid: u32) -> Option<u64> {
    parse(&fs::read_to_string(format!("/proc/{pid}/status")).ok()?)
}

fn parse(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kilobytes << 10)
}

/// Processes that the kernel has killed for want of memory since it started; `None` where it does not count them.
pub fn oom_kills() -> Option<u64> {
    let counters = fs::read_to_string("/proc/vmstat").ok()?;
    let count = counters.lines().find_map(|line| line.strip_prefix("oom_kill "))?;
    count.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_memory_grows_with_what_is_touched() {
        // Other tests of this process take and give back memory at the same time, but never so much.
        let block = vec![1_u8; 256 << 20];
        let after = anonymous_bytes(std::process::id()).unwrap();
        assert!(after >= block.len() as u64, "{after}");
        drop(block);
        let before = anonymous_bytes(std::process::id()).unwrap();
        assert!(
            after >= before + (128 << 20),
            "{before}, {after} with a block of 256 MiB"
        );
        assert_eq!(anonymous_bytes(u32::MAX), None);
    }

    #[test]
    fn kilobytes_are_read() {
        assert_eq!(
            parse("Name:\tx\nRssAnon:\t    1024 kB\nRssFile:\t 5 kB\n"),
            Some(1 << 20)
        );
        assert_eq!(parse("Name:\tx\n"), None);
    }
}
