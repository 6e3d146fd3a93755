//! The statistics: a table for people, one flat JSON object for programs.

use super::answer::{note, say};
use super::failure::Failure;
use super::files;
use pbgi_client::size::scaled_bytes;
use pbgi_client::{Client, serialize_statistics};
use pbgi_core::Statistics;
use pbgi_core::statistics::Unit;
use std::path::Path;

/// Prints the table, and writes the file if one is asked for.
pub(crate) fn report(statistics: &Statistics, file: Option<&Path>) -> Result<(), Failure> {
    say(&table(statistics))?;
    if let Some(text) = slowest_stage(statistics) {
        note(format_args!("{text}"));
    }
    if let Some(text) = statistics.diagnosis() {
        note(format_args!("note: {text}"));
    }
    match file {
        Some(path) => files::write_whole(path, json(statistics).as_bytes()),
        None => Ok(()),
    }
}

/// What a build spent most of its time on, where that is worth knowing.
fn slowest_stage(statistics: &Statistics) -> Option<String> {
    const WORTH_SECS: f64 = 1.0;
    let (sort, build) = (statistics.sort_seconds?, statistics.build_seconds?);
    let (stage, seconds) = match sort > build {
        true => ("reading and sorting the points", sort),
        false => ("making the octree", build),
    };
    let all = sort + build;
    (all > WORTH_SECS).then(|| format!("most of the time went into {stage}: {seconds:.1} of {all:.1} s"))
}

/// Rows that have a value: name, value, unit, and the name for people.
pub(crate) fn table(statistics: &Statistics) -> String {
    let rows = statistics.rows();
    let figures = rows.iter().filter_map(|row| Some((row, figure(row.unit, row.value?))));
    let figures: Vec<_> = figures.collect();
    let names = figures.iter().map(|(row, _)| row.name.len()).max().unwrap_or(0);
    let values = figures.iter().map(|(_, (value, _))| value.len()).max().unwrap_or(0);
    figures
        .iter()
        .map(|(row, (value, unit))| format!("{:names$}  {value:>values$} {unit:<3}  {}\n", row.name, row.label))
        .collect()
}

/// Every row by name, in the table's order; `null` where it does not apply.
pub(crate) fn json(statistics: &Statistics) -> String {
    let mut bytes = Vec::new();
    let mut serializer = serde_json::Serializer::pretty(&mut bytes);
    // A vector takes every byte, and names and numbers are always JSON.
    let written = serialize_statistics(statistics, &mut serializer);
    debug_assert!(written.is_ok());
    bytes.push(b'\n');
    String::from_utf8_lossy(&bytes).into_owned()
}

/// JSON for people and programs. What commands print are plain records: they have no map keys and numbers that JSON lacks.
pub(crate) fn pretty(value: &impl serde::Serialize) -> String {
    serde_json::to_string_pretty(value).unwrap_or_default()
}

/// JSON of what daemons answered, each with its address.
pub(crate) fn at_address<T: serde::Serialize>(answers: &[(Client, T)]) -> String {
    #[derive(serde::Serialize)]
    struct Answer<'a, T> {
        address: &'a str,
        #[serde(flatten)]
        answer: &'a T,
    }
    let answers = answers.iter().map(|(client, answer)| Answer {
        address: client.address(),
        answer,
    });
    pretty(&answers.collect::<Vec<_>>())
}

fn figure(unit: Unit, value: f64) -> (String, &'static str) {
    match unit {
        Unit::Count if value.fract() == 0.0 => (grouped(value as u64), ""),
        Unit::Count => (format!("{value:.1}"), ""),
        Unit::Seconds => (format!("{value:.3}"), "s"),
        Unit::Ratio => (format!("{:.2}", value * 100.0), "%"),
        Unit::Bytes => match scaled_bytes(value) {
            (value, "B") => (format!("{value:.0}"), "B"),
            (value, unit) => (format!("{value:.1}"), unit),
        },
    }
}

/// 1234567 as 1,234,567.
pub(crate) fn grouped(value: u64) -> String {
    let digits = value.to_string();
    let mut text = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Statistics {
        Statistics {
            points: Some(1_234_567.0),
            shading_seconds: Some(1.25),
            out_of_core_bytes: Some(3.0 * 1024.0 * 1024.0),
            cache_hit_ratio: Some(0.99964),
            average_cut_size: Some(42.25),
            ..Default::default()
        }
    }

    #[test]
    fn the_json_has_every_name_and_null_where_it_does_not_apply() {
        let text = json(&sample());
        let object: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&text).unwrap();
        let names = "points nodes shading_calls sort_seconds build_seconds shading_seconds shading_cpu_seconds \
            shading_io_seconds out_of_core_bytes cache_peak_bytes peak_memory_bytes cache_hit_ratio cache_io_ratio \
            points_skipped redundant_reads reloads average_cut_size average_nodes_traversed average_traversal_bytes pages_loaded bytes_read \
            bytes_written local_hits shared_hits shared_hits_other_job cache_misses holes";
        for name in names.split_whitespace() {
            assert!(object.contains_key(name), "{name}");
        }
        assert_eq!(object.len(), names.split_whitespace().count());
        assert_eq!(object["points"], serde_json::json!(1_234_567));
        assert_eq!(object["cache_hit_ratio"], serde_json::json!(0.99964));
        assert!(object["nodes"].is_null());
    }

    #[test]
    fn the_slowest_stage_of_a_long_build_is_named() {
        let took = |sort, build| {
            slowest_stage(&Statistics {
                sort_seconds: Some(sort),
                build_seconds: Some(build),
                ..Default::default()
            })
        };
        let text = took(1.5, 4.5).unwrap();
        assert_eq!(text, "most of the time went into making the octree: 4.5 of 6.0 s");
        assert!(took(4.5, 1.5).unwrap().contains("sorting the points: 4.5"));
        assert_eq!(took(0.2, 0.3), None);
        assert_eq!(slowest_stage(&sample()), None);
    }

    #[test]
    fn infinite_values_do_not_break_the_json() {
        let statistics = Statistics {
            cache_io_ratio: Some(f64::NAN),
            ..Default::default()
        };
        let object: serde_json::Value = serde_json::from_str(&json(&statistics)).unwrap();
        assert!(object["cache_io_ratio"].is_null());
    }

    #[test]
    fn the_table_aligns_what_applies() {
        let text = table(&sample());
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 5);
        assert!(
            lines[0].contains("1,234,567") && lines[0].ends_with("Point count"),
            "{text}"
        );
        assert!(
            text.contains("99.96 %") && text.contains("3.0 MiB") && text.contains("1.250 s"),
            "{text}"
        );
        let label = |line: &str| line.find(|c: char| c.is_ascii_uppercase() && c != 'M').unwrap();
        assert_eq!(label(lines[0]), label(lines[1]));
    }
}
