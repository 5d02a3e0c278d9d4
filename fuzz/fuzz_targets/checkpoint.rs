//! Checkpoints: a file is refused or holds a state that survives being saved.
//!
//! The seal is recomputed before the input is loaded, so that the checksum does not reject mutated files.
#![no_main]

use std::fs;

use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};
use tandem_fuzz::{safetensors_file, sample, scratch_file, with_bounded_memory, write};
use tandem_learner::checkpoint::{self, CheckpointError};

fuzz_target!(|file: &[u8]| {
    let (path, config) = (scratch_file("00000001.safetensors"), sample::run_config());
    let sealed = safetensors_file::seal_anew(file);
    if sealed != file {
        write(&path, file);
        let refused = with_bounded_memory(|| checkpoint::load(&path, &config));
        assert!(
            matches!(refused, Err(CheckpointError::Damaged { .. })),
            "a wrong seal was accepted"
        );
    }
    write(&path, &sealed);
    let Ok(restored) = with_bounded_memory(|| checkpoint::load(&path, &config)) else { return };
    let again = scratch_file("again");
    let saved = checkpoint::save(&again, &restored.trainer, &restored.resumption, 1);
    let saved = saved.expect("a state that was loaded can be saved");
    let reloaded = checkpoint::load(&saved.path, &config).expect("what was saved can be loaded");
    assert_eq!(reloaded.trainer.digest(), restored.trainer.digest());
    fs::remove_dir_all(&again).expect("the directory was just made");
});

fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    let mutated = safetensors_file::mutate_file(&data[..size], max_size, seed, fuzzer_mutate);
    let n = mutated.len().min(max_size);
    data[..n].copy_from_slice(&mutated[..n]);
    n
});
