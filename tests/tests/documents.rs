//! What the documents say of files, messages and options is so.

#![allow(clippy::unwrap_used, reason = "tests")]

use pbgi_tests::{House, workspace_root};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Every file below a folder that ends like this, target folders aside.
fn files(folder: &Path, ending: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap().flatten() {
        let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        if entry.file_type().unwrap().is_dir() {
            if name != "target" && !name.starts_with('.') {
                found.extend(files(&path, ending));
            }
        } else if name.ends_with(ending) {
            found.push(path);
        }
    }
    found
}

/// A heading as links name it: lower case, blanks as hyphens, no punctuation.
fn anchor(heading: &str) -> String {
    let kept = |c: &char| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_');
    heading
        .to_lowercase()
        .chars()
        .filter(kept)
        .collect::<String>()
        .replace(' ', "-")
}

#[test]
fn every_link_of_the_documents_leads_somewhere() {
    let mut count = 0;
    for document in files(&workspace_root(), ".md") {
        let text = fs::read_to_string(&document).unwrap();
        for link in text.split("](").skip(1).map(|rest| rest.split(')').next().unwrap()) {
            if link.starts_with("http") {
                continue;
            }
            let (file, place) = link.split_once('#').unwrap_or((link, ""));
            let target = if file.is_empty() {
                document.clone()
            } else {
                document.parent().unwrap().join(file)
            };
            assert!(
                fs::metadata(&target).is_ok(),
                "{document:?} links to {link}, which is not there"
            );
            if !place.is_empty() {
                let target = fs::read_to_string(&target).unwrap();
                let mut headings = target.lines().filter(|line| line.starts_with('#'));
                let found = headings.any(|line| anchor(line.trim_start_matches('#').trim()) == place);
                assert!(found, "{document:?} links to {link}, which has no such heading");
            }
            count += 1;
        }
    }
    assert!(count > 50, "{count} links");
}

#[test]
fn pictures_of_the_documents_are_small() {
    for picture in files(&workspace_root().join("docs"), ".png") {
        let bytes = fs::metadata(&picture).unwrap().len();
        assert!(bytes <= 400_000, "{picture:?} has {bytes} bytes: make it smaller");
    }
}

/// Texts of all programs, in which a string that goes on in the next line is one.
fn sources() -> String {
    let mut text = String::new();
    for folder in ["engine", "server", "worker", "client"] {
        for source in files(&workspace_root().join(folder), ".rs") {
            let lines = fs::read_to_string(source).unwrap();
            let mut lines = lines.split("\\\n");
            text += lines.next().unwrap();
            lines.for_each(|line| text += line.trim_start());
        }
    }
    text
}

#[test]
fn messages_in_the_guide_are_those_of_the_programs() {
    let guide = fs::read_to_string(workspace_root().join("docs/guide.md")).unwrap();
    let (_, section) = guide.split_once("## When it does not work").unwrap();
    let (messages, _) = section.split_once("**No message").unwrap();
    let sources = sources();
    let mut count = 0;
    for row in messages.lines().filter(|line| line.starts_with("| `")) {
        let cell = row[2..].split(" | ").next().unwrap();
        // What stands between backquotes is a message, with an ellipsis for what varies.
        for message in cell.split('`').skip(1).step_by(2) {
            for part in message.split("...").map(str::trim).filter(|part| !part.is_empty()) {
                assert!(sources.contains(part), "no program says {part:?}, of {message:?}");
            }
            count += 1;
        }
    }
    assert!(count > 30, "{count} messages");
}

#[test]
fn options_in_the_documents_are_those_of_the_commands() {
    let house = House::new();
    let mut helps = BTreeMap::new();
    let mut seen = BTreeSet::new();
    let mut documents = files(&workspace_root().join("docs"), ".md");
    documents.push(workspace_root().join("README.md"));
    for document in documents {
        let text = fs::read_to_string(&document).unwrap();
        for line in text.lines().filter_map(|line| line.strip_prefix("    ")) {
            let mut words = line.split_whitespace();
            let command = words.next().unwrap_or_default();
            let Some(verb) = words.next().filter(|_| command.ends_with("pbgi-client")) else {
                continue;
            };
            let help = helps
                .entry(verb.to_owned())
                .or_insert_with(|| house.run([verb, "--help"]).ok().stdout);
            for word in words.filter(|word| word.starts_with("--")) {
                let option = word.split('=').next().unwrap();
                let known = help
                    .split(|c: char| !(c.is_alphanumeric() || c == '-'))
                    .any(|word| word == option);
                assert!(known, "{document:?} has {line:?}, but {verb} knows no {option}");
                seen.insert(option.to_owned());
            }
        }
    }
    assert!(seen.len() > 15, "{seen:?}");
}
