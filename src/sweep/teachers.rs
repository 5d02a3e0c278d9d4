//! The teachers of a sweep's runs, which are checked before the first run starts.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::PathBuf;

use super::run_status::{RunStatus, State};
use crate::exit::Failed;
use crate::service::policy_address;
use crate::train::teacher_file::{TeacherFile, path_of_new_run};

/// Rejects teachers that cannot advise the runs that are new. Other runs have copies of theirs, and a teacher on a server
/// is asked when its run starts.
pub(super) fn check(statuses: &[RunStatus]) -> Result<(), Failed> {
    let mut teachers: BTreeMap<PathBuf, TeacherFile> = BTreeMap::new();
    let is_new = |status: &&RunStatus| status.state == State::New;
    for run in statuses.iter().filter(is_new).map(|status| &status.run) {
        if !run.config.advice.needs_teacher() {
            continue;
        }
        let refused = |failed: Failed| {
            let name = &run.name;
            Failed::usage(format!("the teacher of {name}: {:#}", failed.into_error()))
        };
        let path = path_of_new_run(run.teacher.as_deref(), &run.config).map_err(refused)?;
        if policy_address(&path).is_some() {
            continue;
        }
        let teacher = match teachers.entry(path.clone()) {
            Entry::Occupied(loaded) => loaded.into_mut(),
            Entry::Vacant(free) => free.insert(TeacherFile::load(path, None).map_err(refused)?),
        };
        teacher.check(&run.config).map_err(refused)?;
    }
    Ok(())
}
