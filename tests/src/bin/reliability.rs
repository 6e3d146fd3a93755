//! Prints the reliability table: what may go wrong, what is promised, which test proves it, its number, and whether it is green.
//!
//!     cargo build --workspace --bins
//!     target/debug/reliability           the quick rows
//!     target/debug/reliability --slow    all, which takes many minutes
//!     target/debug/reliability P8 R6     these rows
//!
//! Rows are in `tests/reliability.toml`. A test prints its number as a line `RELIABILITY ID: text`; one that prints none has its
//! outcome for a number. Exits with 1 if a row is red.
#![forbid(unsafe_code)]

use pbgi_tests::workspace_root;
use serde::Deserialize;
use std::collections::HashMap;
use std::io::Write;
use std::process::{Command, ExitCode};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    row: Vec<Row>,
}

#[derive(Deserialize)]
struct Row {
    id: String,
    promise: String,
    #[serde(flatten)]
    proof: Option<Proof>,
    #[serde(default)]
    slow: bool,
}

#[derive(Clone, Deserialize, PartialEq, Eq, Hash)]
struct Proof {
    package: String,
    /// A test program, or `lib`.
    target: String,
    test: String,
}

/// How a test went: whether it passed, and what it printed.
type Outcome = (bool, String);

fn main() -> ExitCode {
    let path = workspace_root().join("tests/reliability.toml");
    let table = std::fs::read_to_string(&path).map_err(|error| error.to_string());
    let table = table.and_then(|text| toml::from_str::<Table>(&text).map_err(|error| error.to_string()));
    let table = match table {
        Ok(table) => table,
        Err(error) => {
            eprintln!("cannot read {}: {error}", path.display());
            return ExitCode::from(2);
        }
    };
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let slow = arguments.iter().any(|argument| argument == "--slow");
    let named: Vec<&String> = arguments.iter().filter(|argument| !argument.starts_with('-')).collect();
    let mut ran: HashMap<Proof, Outcome> = HashMap::new();
    let mut counts = [0; 4];
    println!("| row | promise | proof | number | |\n|---|---|---|---|---|");
    for row in &table.row {
        let wanted = if named.is_empty() {
            slow || !row.slow
        } else {
            named.contains(&&row.id)
        };
        let (proof, number, verdict) = match &row.proof {
            None => (String::new(), String::new(), 2),
            Some(proof) if !wanted => (name(proof), String::new(), 3),
            Some(proof) => {
                let (passed, text) = ran.entry(proof.clone()).or_insert_with(|| run(proof));
                (name(proof), number(&row.id, text), usize::from(!*passed))
            }
        };
        counts[verdict] += 1;
        let word = ["green", "RED", "open", "not run"][verdict];
        println!("| {} | {} | {proof} | {number} | {word} |", row.id, row.promise);
        // Tests take their time; what is known is shown. A reader that left does not care.
        let _ = std::io::stdout().flush();
    }
    let [green, red, open, not_run] = counts;
    println!("\n{green} green, {red} red, {open} open, {not_run} not run");
    ExitCode::from(u8::from(red > 0))
}

fn name(proof: &Proof) -> String {
    let test = proof.test.rsplit("::").next().unwrap_or(&proof.test);
    format!("`{}` {}: `{test}`", proof.package, proof.target)
}

fn run(proof: &Proof) -> Outcome {
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    // The whole workspace, so that what `cargo test --workspace` built is what runs.
    cargo
        .current_dir(workspace_root())
        .args(["test", "--workspace", "--quiet", "--locked"]);
    if !cfg!(debug_assertions) {
        cargo.arg("--release");
    }
    match proof.target.as_str() {
        "lib" => cargo.arg("--lib"),
        target => cargo.args(["--test", target]),
    };
    cargo.args(["--", "--exact", "--nocapture", "--include-ignored", &proof.test]);
    match cargo.output() {
        Ok(output) => {
            let text = String::from_utf8_lossy(&output.stdout).into_owned();
            // A name that no test has any more passes with nothing run.
            (output.status.success() && text.contains("1 passed"), text)
        }
        Err(error) => (false, error.to_string()),
    }
}

/// What the test printed for this row.
fn number(id: &str, text: &str) -> String {
    let mark = format!("RELIABILITY {id}: ");
    let found = text.lines().find_map(|line| Some(line.split_once(&mark)?.1));
    found.unwrap_or("passes or fails").replace('|', "/")
}
