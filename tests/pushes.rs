//! Shipped push policies move their cubes from the side; they do not drag them from above or tip them.

use std::path::Path;

use tandem_core::World;
use tandem_policy::Policy;

#[path = "../examples/pushes.rs"]
#[expect(dead_code, reason = "the example's main function is not used")]
mod pushes;

/// Largest share of a cube's path on which no hand touches it. The fast hands of the classic world hit their cubes,
/// which glide on.
const MAX_GLIDING: [(World, f64); 2] = [(World::Classic, 1.0), (World::Shared, 0.1)];

const N_EPISODES: u64 = 100;

fn check(name: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies").join(name);
    let policy = Policy::load(&path).expect("ships");
    let world = policy.task.as_built_in().expect("a built-in task").task.world();
    let pushes = pushes::measure(&policy, N_EPISODES).expect("plays");
    let (above, gliding) = (pushes.share_above(), pushes.share_gliding());
    assert!(pushes.success >= 0.95, "{name}: success {}", pushes.success);
    assert!(pushes.n_moving > 400, "{name}: the cubes hardly move");
    assert!(above < 0.05, "{name}: the hand is above the cube in {above:.2} of the moving steps");
    let n_tipping = pushes.n_tipping;
    assert!(n_tipping < 10, "{name}: a cube tips in {n_tipping} of {N_EPISODES} episodes");
    let max = MAX_GLIDING.iter().find(|(of, _)| *of == world).expect("every world").1;
    assert!(gliding <= max, "{name}: cubes glide on {gliding:.2} of their path");
}

#[test]
fn shipped_policies_push() {
    let policies = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies");
    let files = std::fs::read_dir(policies).expect("policies ship");
    let names = files.map(|file| file.expect("readable").file_name().into_string().expect("UTF-8"));
    let names: Vec<String> = names.filter(|name| name.contains("push")).collect();
    assert!(names.len() >= 2, "a teacher and a student ship: {names:?}");
    names.iter().for_each(|name| check(name));
}
