//! Episode logs (MCAP): reading refuses or accepts a log; recovery turns any prefix of a log into a complete file.
#![no_main]

use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};
use tandem_fuzz::{mcap_file, scratch_file, with_bounded_memory, write};
use tandem_telemetry::{Error, read_episode, recover};

fuzz_target!(|file: &[u8]| {
    let path = scratch_file("episode.mcap");
    let unchecked = mcap_file::without_checksums(file);
    if unchecked != file {
        write(&path, file);
        drop(with_bounded_memory(|| read_episode(&path)));
    }
    write(&path, &unchecked);
    let read = with_bounded_memory(|| read_episode(&path));
    let recovered_path = scratch_file("recovered.mcap");
    let recovered = with_bounded_memory(|| recover(&path, &recovered_path));
    match (read, recovered) {
        (Ok(log), recovered) => {
            let recovered = recovered.expect("a whole log can be copied");
            assert_eq!(recovered.ended_by, None, "a whole log was called damaged");
            let copy = read_episode(&recovered_path).expect("the copy of a log is a log");
            // Logs are compared in printed form, because NaN differs from itself.
            assert_eq!(format!("{copy:?}"), format!("{log:?}"));
        }
        (Err(_), Ok(_)) => {
            let copy = read_episode(&recovered_path);
            assert!(!matches!(copy, Err(Error::ReadLog { .. })), "not whole: {copy:?}");
        }
        (Err(_), Err(error)) => {
            let is_expected =
                matches!(error, Error::NotMcap { .. } | Error::NothingToRecover { .. });
            assert!(is_expected, "{error:?}");
        }
    }
});

fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    let mutated = mcap_file::mutate_file(&data[..size], max_size, seed, fuzzer_mutate);
    let n = mutated.len().min(max_size);
    data[..n].copy_from_slice(&mutated[..n]);
    n
});
