//! Policy files: a file is refused or holds a policy that acts and survives being saved.
#![no_main]

use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};
use tandem_fuzz::{safetensors_file, scratch_file, with_bounded_memory, write};
use tandem_policy::Policy;

fuzz_target!(|file: &[u8]| {
    let path = scratch_file("policy.safetensors");
    write(&path, file);
    let Ok(policy) = with_bounded_memory(|| Policy::load(&path)) else { return };
    let task = policy.task.clone();
    let mut actor = policy.actor().expect("a policy that was loaded can act");
    let mut action = vec![f32::NAN; task.n_action()];
    actor.act(&vec![0.5; task.n_observation()], &vec![-0.5; task.n_goal()], &mut action);
    policy.critic().expect("a policy that was loaded values actions");
    policy.save(&path).expect("a policy that was loaded can be saved");
    assert_eq!(Policy::load(&path).expect("a saved policy can be loaded"), policy);
});

fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    let mutated = safetensors_file::mutate_file(&data[..size], max_size, seed, fuzzer_mutate);
    let n = mutated.len().min(max_size);
    data[..n].copy_from_slice(&mutated[..n]);
    n
});
