//! The values of a run in tables and exports.

use crate::run::Run;

/// Returns the success on test goals and their number.
pub(crate) fn test_success(run: &Run) -> Option<(f64, u64)> {
    run.test.as_ref().map(|test| (test.success, test.n_episodes))
}

/// Returns the success of the best policy of a run, on the goals that selected it, and the number of its episodes.
pub(crate) fn best_success(run: &Run) -> Option<(f64, u64)> {
    run.best().map(|row| (row.success, row.n_episodes))
}

pub(crate) fn env_steps(run: &Run) -> Option<f64> {
    Some(run.last()?.env_steps as f64)
}

/// Returns the number of steps on which the teacher was asked.
pub(crate) fn advice_queries(run: &Run) -> Option<f64> {
    Some(run.last()?.advice_queries? as f64)
}

pub(crate) fn advice_spent(run: &Run) -> Option<f64> {
    Some(run.last()?.advice_spent as f64)
}

/// Returns the success by the joint norm, on test goals or else of the last evaluation.
pub(crate) fn success_joint(run: &Run) -> Option<f64> {
    let test = run.test.as_ref().map(|test| test.success_joint);
    test.or_else(|| run.last().map(|row| row.success_joint))
}

/// Returns the success of each arm, on test goals or else of the last evaluation. Empty if it is unknown.
pub(crate) fn success_per_arm(run: &Run) -> &[f64] {
    match (&run.test, run.last()) {
        (Some(test), _) => &test.success_per_arm,
        (None, Some(row)) => &row.success_per_arm,
        (None, None) => &[],
    }
}

/// Returns the success without contact between the arms on test goals, and their number, if it is known.
pub(crate) fn success_without_contact(run: &Run) -> Option<(f64, u64)> {
    let test = run.test.as_ref()?;
    Some((test.contacts.success_without_contact?, test.n_episodes))
}

/// Returns the share of episodes with a contact, on test goals or else of the last evaluation.
///
/// A task that reports no contacts has no such share.
pub(crate) fn collision_rate(run: &Run) -> Option<f64> {
    let last = || run.last().filter(|_| run.reports_contacts()).map(|row| row.collision_rate);
    test_collision_rate(run).map(|(share, _)| share).or_else(last)
}

/// Returns the share of episodes with a contact on test goals, and their number, if the task reports contacts.
pub(crate) fn test_collision_rate(run: &Run) -> Option<(f64, u64)> {
    let test = run.test.as_ref().filter(|_| run.reports_contacts())?;
    Some((test.collision_rate?, test.n_episodes))
}
