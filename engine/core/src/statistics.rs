//! The rows of the paper's Table 1, and ours beside them, under the names that the terminal, the job record, the EXR header
//! and the statistics file share.

use serde::{Deserialize, Serialize};

macro_rules! statistics {
    ($($(#[$doc:meta])* $name:ident: $unit:ident $label:literal,)*) => {
        /// One flat record a command; `None` where a row does not apply.
        #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct Statistics {
            $($(#[$doc])* pub $name: Option<f64>,)*
        }

        impl Statistics {
            /// Every row: name, label, unit, value. The order is the table's.
            pub fn rows(&self) -> Vec<Row> {
                vec![$(Row { name: stringify!($name), label: $label, unit: Unit::$unit, value: self.$name },)*]
            }

            /// Takes every row that `other` has.
            pub fn update(&mut self, other: &Self) {
                $(if other.$name.is_some() { self.$name = other.$name; })*
            }

            /// Sets a row by name; `false` if there is none of that name.
            pub fn set(&mut self, name: &str, value: f64) -> bool {
                match name {
                    $(stringify!($name) => self.$name = Some(value),)*
                    _ => return false,
                }
                true
            }
        }
    };
}

/// One row of the table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Name in JSON and in records.
    pub name: &'static str,
    /// Name for people, the paper's where it has one.
    pub label: &'static str,
    /// Unit of the value.
    pub unit: Unit,
    /// The value.
    pub value: Option<f64>,
}

/// Unit of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// A plain number of things.
    Count,
    /// Seconds.
    Seconds,
    /// Bytes.
    Bytes,
    /// A share from 0 to 1.
    Ratio,
}

statistics! {
    /// Points of the scene.
    points: Count "Point count",
    /// Points of the input that could not be used and were dropped.
    points_skipped: Count "Points skipped",
    /// Nodes of the scene.
    nodes: Count "Node count",
    /// Receivers shaded.
    shading_calls: Count "Shading calls",
    /// Wall time of reading, sorting and merging.
    sort_seconds: Seconds "Point sort time",
    /// Wall time of construction and writing.
    build_seconds: Seconds "Octree build time",
    /// Wall time of shading.
    shading_seconds: Seconds "Shading time",
    /// Processor time of shading, summed over workers.
    shading_cpu_seconds: Seconds "Shading CPU time",
    /// Time that workers waited for pages, summed.
    shading_io_seconds: Seconds "Shading I/O time",
    /// Bytes of the scene's pages.
    out_of_core_bytes: Bytes "Out-of-core data",
    /// Most bytes of pages resident at once.
    cache_peak_bytes: Bytes "Cache peak RAM",
    /// Segment and private memory of all processes at their peak.
    peak_memory_bytes: Bytes "Peak memory",
    /// Page requests served without the disk.
    cache_hit_ratio: Ratio "Cache hit ratio",
    /// Distinct bytes read over the scene's bytes.
    cache_io_ratio: Ratio "Cache I/O ratio",
    /// Loads of a page that was resident: always 0.
    redundant_reads: Count "Redundant reads",
    /// Pages evicted and read again.
    reloads: Count "Reloads",
    /// Clusters and points on the cut of a receiver.
    average_cut_size: Count "Avg. cut size",
    /// Nodes visited to find the cut.
    average_nodes_traversed: Count "Avg. nodes traversed per cut",
    /// Bytes of the pages that one receiver needs.
    average_traversal_bytes: Bytes "Avg. traversal memory",
    /// Pages read from disk.
    pages_loaded: Count "Pages loaded",
    /// Bytes read from disk.
    bytes_read: Bytes "Bytes read",
    /// Bytes written to disk.
    bytes_written: Bytes "Bytes written",
    /// Requests served by a worker's own cache.
    local_hits: Count "Local hits",
    /// Requests served by the shared cache.
    shared_hits: Count "Shared hits",
    /// Shared hits on pages that another job brought in.
    shared_hits_other_job: Count "Shared hits, other job's pages",
    /// Requests that went to the disk.
    cache_misses: Count "Cache misses",
    /// Pixels without a receiver.
    holes: Count "Holes",
}

/// Reloads per page loaded from which the cache is said to be too small: one page in four was read before.
const RELOADS_TOO_MANY: f64 = 0.25;

impl Statistics {
    /// What was wrong with the memory, for people: whether a cut fitted the cache.
    pub fn diagnosis(&self) -> Option<String> {
        let (reloads, loads) = (self.reloads?, self.pages_loaded?);
        if reloads == 0.0 || reloads < loads * RELOADS_TOO_MANY {
            return None;
        }
        let mib = |bytes: f64| format!("{:.1} MiB", bytes / f64::from(1 << 20));
        let (cut, cache) = (self.average_traversal_bytes?, self.cache_peak_bytes?);
        // Workers may hold half of the cache (the other half is what they let go of last).
        let what = if cut > cache / 2.0 {
            "a receiver's cut does not fit the cache"
        } else {
            "the cuts of neighbouring receivers do not fit the cache together"
        };
        Some(format!(
            "{what}: {reloads:.0} of {loads:.0} page loads were of pages that had been evicted; a receiver touches {} of \
             pages on average, and the cache held {} at most; give the daemon more --memory, or build the scene with \
             smaller pages",
            mib(cut),
            mib(cache)
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cut_that_does_not_fit_is_told_from_cuts_that_do_not_fit_together() {
        let statistics = |reloads, traversal| Statistics {
            reloads: Some(reloads),
            pages_loaded: Some(1000.0),
            average_traversal_bytes: Some(traversal),
            cache_peak_bytes: Some(8e6),
            ..Statistics::default()
        };
        assert_eq!(Statistics::default().diagnosis(), None);
        assert_eq!(statistics(0.0, 5e6).diagnosis(), None);
        assert_eq!(statistics(200.0, 5e6).diagnosis(), None);
        let alone = statistics(300.0, 5e6).diagnosis().unwrap();
        assert!(alone.starts_with("a receiver's cut does not fit"), "{alone}");
        assert!(
            alone.contains("300 of 1000") && alone.contains("4.8 MiB") && alone.contains("7.6 MiB"),
            "{alone}"
        );
        let together = statistics(300.0, 3e6).diagnosis().unwrap();
        assert!(together.starts_with("the cuts of neighbouring"), "{together}");
    }

    #[test]
    fn rows_are_set_and_read_by_name() {
        let mut statistics = Statistics::default();
        assert!(statistics.set("points", 5.0));
        assert!(!statistics.set("surfels", 5.0));
        assert_eq!(statistics.points, Some(5.0));
        assert_eq!(statistics.rows().len(), 27);
    }
}
