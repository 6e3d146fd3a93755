//! Keeps a build child to the directories that its client may name files in: a mesh names other files, and a hostile one names
//! those of others.

use landlock::{
    ABI, Access, AccessFs, CompatLevel, Compatible, PathBeneath, PathFd, Ruleset, RulesetAttr, RulesetCreatedAttr,
    RulesetStatus,
};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Directories that may be used, and what is below them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Confine {
    /// Read.
    pub read: Vec<PathBuf>,
    /// Read and written.
    pub write: Vec<PathBuf>,
}

/// What every program reads of the system.
const SYSTEM: [&str; 2] = ["/proc", "/dev"];

/// Gives up everything else, for this thread and those it starts.
///
/// # Errors
/// A kernel without Landlock, or a directory that is not there.
pub fn confine(confine: &Confine) -> Result<(), String> {
    let abi = ABI::V3;
    let failed = |error: &dyn std::fmt::Display| format!("cannot confine the build to its roots: {error}");
    let mut rules = Ruleset::default()
        .set_compatibility(CompatLevel::HardRequirement)
        .handle_access(AccessFs::from_all(abi))
        .and_then(Ruleset::create)
        .map_err(|error| failed(&error))?;
    let system = SYSTEM.iter().map(Path::new);
    let read = confine.read.iter().map(PathBuf::as_path).chain(system);
    let read = read.map(|path| (path, AccessFs::from_read(abi)));
    let write = confine
        .write
        .iter()
        .map(|path| (path.as_path(), AccessFs::from_all(abi)));
    for (path, access) in read.chain(write) {
        let opened = PathFd::new(path).map_err(|error| failed(&error))?;
        rules = rules
            .add_rule(PathBeneath::new(opened, access))
            .map_err(|error| failed(&error))?;
    }
    let status = rules.restrict_self().map_err(|error| failed(&error))?;
    match status.ruleset {
        RulesetStatus::FullyEnforced => Ok(()),
        _ => Err(failed(&"this kernel enforces only a part of it")),
    }
}
