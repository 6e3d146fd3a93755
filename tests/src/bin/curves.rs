//! Draws the tables of a benchmark as curves, an SVG file.
//!
//!     cargo run -p pbgi-tests --bin curves -- docs/gathering.md docs/images/gathering.svg
//!     cargo run -p pbgi-tests --bin curves -- docs/cache.md docs/images/cache.svg
//!
//! The input is what `cargo bench -p pbgi-tests --bench gather` or `--bench cache` printed, or a document that it was
//! pasted into: tables in Markdown, known by their first column. Both axes are logarithmic.
#![forbid(unsafe_code)]

use std::fmt::Write;
use std::process::ExitCode;

/// Columns of a chart and their looks.
const COLUMNS: usize = 2;
const WIDTH: f64 = 370.0;
const HEIGHT: f64 = 250.0;
/// The plot within its chart: left, top, right, bottom.
const PLOT: [f64; 4] = [62.0, 34.0, 350.0, 200.0];
/// Room for the names of the curves, below all charts.
const LEGEND: f64 = 34.0;
/// Stroke and dashes of the curves, in their order.
const LOOKS: [(&str, &str); 4] = [
    ("#2b6cb0", "none"),
    ("#2b6cb0", "5 4"),
    ("#c0392b", "none"),
    ("#2f855a", "none"),
];

/// One picture: what is drawn over what, and how it comes out.
struct Chart {
    title: String,
    x: &'static str,
    y: &'static str,
    /// In the order of [`LOOKS`], from left to right.
    curves: Vec<Vec<[f64; 2]>>,
}

/// All charts of a file and what their curves are called.
struct Sheet {
    names: Vec<&'static str>,
    charts: Vec<Chart>,
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [input, output] = arguments.as_slice() else {
        eprintln!("usage: curves TABLES.md CURVES.svg");
        return ExitCode::from(2);
    };
    let drawn = std::fs::read_to_string(input)
        .map_err(|error| format!("cannot read {input}: {error}"))
        .and_then(|text| read(&text).ok_or_else(|| format!("no table of gather or of cache policy in {input}")))
        .and_then(|sheet| {
            std::fs::write(output, draw(&sheet)).map_err(|error| format!("cannot write {output}: {error}"))
        });
    match drawn {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// The tables of a text, each below its last heading, as rows of cells.
fn tables(text: &str) -> Vec<(&str, Vec<Vec<&str>>)> {
    let (mut heading, mut found, mut inside) = ("", Vec::<(&str, Vec<Vec<&str>>)>::new(), false);
    for line in text.lines() {
        if let Some(title) = line.strip_prefix("## ") {
            heading = title;
        }
        let cells = line.strip_prefix('|').and_then(|line| line.strip_suffix('|'));
        if let Some(cells) = cells {
            if !inside {
                found.push((heading, Vec::new()));
            }
            if let Some((_, rows)) = found.last_mut() {
                rows.push(cells.split('|').map(str::trim).collect());
            }
        }
        inside = cells.is_some();
    }
    found
}

fn read(text: &str) -> Option<Sheet> {
    let tables = tables(text);
    let first = |table: &&(&str, Vec<Vec<&str>>), name: &str| table.1.first().is_some_and(|row| row[0] == name);
    let mut charts: Vec<Chart> = tables
        .iter()
        .filter(|table| first(table, "method"))
        .flat_map(|(scene, rows)| gather(scene, rows))
        .collect();
    let mut names = vec!["gather, 32 rows", "gather, 64 rows", "rays", "gather, interpolated"];
    if charts.is_empty() {
        charts = tables
            .iter()
            .filter(|table| first(table, "Cache, of the scene"))
            .flat_map(|(_, rows)| policy(rows))
            .collect();
        let budgets = tables.iter().filter(|table| first(table, "Pages over a traversal"));
        charts.extend(budgets.filter_map(|(_, rows)| budget(rows)));
        names = vec!["this cache", "clock", "exact LRU"];
    }
    (!charts.is_empty()).then_some(Sheet { names, charts })
}

/// Error against time, for occlusion and for indirect light.
fn gather(scene: &str, rows: &[Vec<&str>]) -> [Chart; 2] {
    let chart = |what: &str, y: &'static str, column: usize, rays: &str| {
        let curve = |end: &str| {
            let mine = rows.iter().filter(|row| row[0].ends_with(end));
            sorted(mine.filter_map(|row| Some([number(row, 1)?, number(row, column)?])))
        };
        Chart {
            title: format!("{scene}, {what}"),
            x: "microseconds a receiver",
            y,
            curves: [", raster 32", ", raster 64", rays, ", interpolated 0.02"]
                .map(curve)
                .into(),
        }
    };
    [
        chart("occlusion", "RMS", 2, "rays, occlusion alone"),
        chart("indirect light", "RMS over mean, %", 3, "rays, one bounce"),
    ]
}

/// Looks that found nothing against the size of the cache, without and with a scan.
fn policy(rows: &[Vec<&str>]) -> [Chart; 2] {
    let chart = |title: &str, column: usize| {
        let curve = |column: usize| {
            sorted(
                rows.iter()
                    .filter_map(|row| Some([number(row, 0)?, 100.0 - number(row, column)?])),
            )
        };
        Chart {
            title: title.into(),
            x: "cache, % of the scene",
            y: "misses, %",
            curves: [column, column + 2, column + 1].map(curve).into(),
        }
    };
    [chart("two workers", 1), chart("beside a scan", 4)]
}

/// Shading time against the memory for pages; `None` for a single frame.
fn budget(rows: &[Vec<&str>]) -> Option<Chart> {
    let curve = sorted(rows.iter().filter_map(|row| Some([number(row, 0)?, number(row, 3)?])));
    (curve.len() > 1).then(|| Chart {
        title: "a frame out of core".into(),
        x: "pages held, average traversals",
        y: "seconds",
        curves: vec![curve, Vec::new(), Vec::new()],
    })
}

fn sorted(points: impl Iterator<Item = [f64; 2]>) -> Vec<[f64; 2]> {
    let mut points: Vec<_> = points.collect();
    points.sort_by(|a, b| a[0].total_cmp(&b[0]));
    points
}

/// A cell's number, without its unit.
fn number(row: &[&str], column: usize) -> Option<f64> {
    let value: f64 = row.get(column)?.split(' ').next()?.parse().ok()?;
    (value > 0.0).then_some(value)
}

/// A logarithmic axis: numbers from `low` to `high` lie between the pixels `from` and `to`.
struct Axis {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Axis {
    /// Covers all values, from one tick to another.
    fn new(values: impl Iterator<Item = f64> + Clone, from: f64, to: f64) -> Self {
        let low = values.clone().fold(f64::INFINITY, f64::min);
        let high = values.fold(0.0, f64::max);
        let below = ticks().filter(|tick| *tick <= low).last();
        let above = ticks().find(|tick| *tick >= high);
        Self {
            low: below.unwrap_or(low),
            high: above.unwrap_or(high),
            from,
            to,
        }
    }

    fn at(&self, value: f64) -> f64 {
        let share = (value / self.low).ln() / (self.high / self.low).ln();
        self.from + share * (self.to - self.from)
    }

    fn ticks(&self) -> impl Iterator<Item = f64> {
        ticks().filter(|tick| (self.low..=self.high).contains(tick))
    }
}

/// 1, 2 and 5 of every decade that a benchmark could have.
fn ticks() -> impl Iterator<Item = f64> {
    // Parsed, because 5e-3 is not 5 times 0.001 in floating point.
    (-6..7).flat_map(|exponent| {
        [1, 2, 5]
            .into_iter()
            .filter_map(move |digit| format!("{digit}e{exponent}").parse().ok())
    })
}

fn draw(sheet: &Sheet) -> String {
    let rows = sheet.charts.len().div_ceil(COLUMNS);
    let (width, height) = (WIDTH * COLUMNS as f64, HEIGHT * rows as f64 + LEGEND);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\">\n\
         <style>\n  text {{ font: 12px sans-serif; fill: #222 }}\n  .title {{ font-size: 14px }}\n\
         \x20 .grid {{ fill: none; stroke: #ddd }}\n  .curve {{ fill: none; stroke-width: 2 }}\n</style>\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n"
    );
    for (index, chart) in sheet.charts.iter().enumerate() {
        let (column, row) = (index % COLUMNS, index / COLUMNS);
        let _ = writeln!(
            svg,
            "<g transform=\"translate({} {})\">",
            WIDTH * column as f64,
            HEIGHT * row as f64
        );
        draw_chart(&mut svg, chart);
        svg += "</g>\n";
    }
    let drawn = |curve: usize| sheet.charts.iter().any(|chart| !chart.curves[curve].is_empty());
    for (index, (name, (colour, dashes))) in sheet
        .names
        .iter()
        .zip(LOOKS)
        .enumerate()
        .filter(|(curve, _)| drawn(*curve))
    {
        let (x, y) = (PLOT[0] + 160.0 * index as f64, HEIGHT * rows as f64 + LEGEND / 2.0);
        let _ = writeln!(
            svg,
            "<path class=\"curve\" stroke=\"{colour}\" stroke-dasharray=\"{dashes}\" d=\"M{x} {y}h28\"/>\
             <text x=\"{}\" y=\"{}\">{name}</text>",
            x + 36.0,
            y + 4.0
        );
    }
    svg + "</svg>\n"
}

fn draw_chart(svg: &mut String, chart: &Chart) {
    let all = || chart.curves.iter().flatten();
    let [left, top, right, bottom] = PLOT;
    let x = Axis::new(all().map(|point| point[0]), left, right);
    let y = Axis::new(all().map(|point| point[1]), bottom, top);
    // A `String` takes whatever is written to it.
    let mut write = |text: std::fmt::Arguments<'_>| {
        let _ = svg.write_fmt(text);
    };
    write(format_args!(
        "<text class=\"title\" x=\"{left}\" y=\"20\">{}</text>\n",
        chart.title
    ));
    for tick in x.ticks() {
        let at = x.at(tick);
        write(format_args!(
            "<path class=\"grid\" d=\"M{at:.1} {top}V{bottom}\"/><text x=\"{at:.1}\" y=\"{}\" text-anchor=\"middle\">{tick}</text>\n",
            bottom + 16.0
        ));
    }
    for tick in y.ticks() {
        let at = y.at(tick);
        write(format_args!(
            "<path class=\"grid\" d=\"M{left} {at:.1}H{right}\"/><text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{tick}</text>\n",
            left - 6.0,
            at + 4.0
        ));
    }
    write(format_args!(
        "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{}</text>\n\
         <text transform=\"translate(14 {}) rotate(-90)\" text-anchor=\"middle\">{}</text>\n",
        (left + right) / 2.0,
        bottom + 34.0,
        chart.x,
        (top + bottom) / 2.0,
        chart.y
    ));
    for (curve, (colour, dashes)) in chart.curves.iter().zip(LOOKS).filter(|(curve, _)| !curve.is_empty()) {
        let points = curve
            .iter()
            .map(|point| format!("{:.1} {:.1}", x.at(point[0]), y.at(point[1])));
        write(format_args!(
            "<path class=\"curve\" stroke=\"{colour}\" stroke-dasharray=\"{dashes}\" d=\"M{}\"/>\n",
            points.collect::<Vec<_>>().join("L")
        ));
        for point in curve {
            write(format_args!(
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"2.5\" fill=\"{colour}\"/>\n",
                x.at(point[0]),
                y.at(point[1])
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_table_of_the_documents_is_drawn() {
        let document = |name: &str| {
            let path = pbgi_tests::workspace_root().join("docs").join(name);
            std::fs::read_to_string(path).unwrap_or_default()
        };
        for (name, charts) in [("gathering.md", 14), ("cache.md", 3)] {
            let sheet = read(&document(name));
            assert_eq!(sheet.as_ref().map(|sheet| sheet.charts.len()), Some(charts), "{name}");
            for chart in sheet.into_iter().flat_map(|sheet| sheet.charts) {
                let drawn = chart.curves[..3].iter().filter(|curve| curve.len() > 2).count();
                let alone = chart.title == "a frame out of core";
                assert_eq!(drawn, if alone { 1 } else { 3 }, "{}", chart.title);
            }
        }
        assert!(read("no table").is_none());
    }
}
