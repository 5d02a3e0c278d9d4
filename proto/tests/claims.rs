//! Decoders allocate memory for the bytes that a message has, not for the length that it claims.
#![expect(unsafe_code, reason = "GlobalAlloc is an unsafe trait")]

use std::alloc::{GlobalAlloc, Layout as Memory, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use prost::Message as _;
use tandem_core::{Layout, Task};
use tandem_proto::pb;

/// The largest allocation since the last reset, bytes.
static LARGEST: AtomicUsize = AtomicUsize::new(0);

struct Counting;

// SAFETY: every call is forwarded to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, memory: Memory) -> *mut u8 {
        LARGEST.fetch_max(memory.size(), Ordering::Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.alloc(memory) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, memory: Memory) {
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(pointer, memory) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, memory: Memory, n_bytes: usize) -> *mut u8 {
        LARGEST.fetch_max(n_bytes, Ordering::Relaxed);
        // SAFETY: as the caller promises.
        unsafe { System.realloc(pointer, memory, n_bytes) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Returns the largest allocation of `work`, bytes.
fn largest(work: impl FnOnce()) -> usize {
    LARGEST.store(0, Ordering::Relaxed);
    work();
    LARGEST.load(Ordering::Relaxed)
}

/// Encodes a length-delimited field that claims to have `n_bytes` and has 3.
fn claim(field: u8, n_bytes: u64) -> Vec<u8> {
    let mut bytes = vec![field << 3 | 2];
    let mut rest = n_bytes;
    while rest >= 0x80 {
        bytes.push(u8::try_from(rest & 0x7f).expect("7 bits") | 0x80);
        rest >>= 7;
    }
    bytes.push(u8::try_from(rest).expect("7 bits"));
    bytes.extend([1, 2, 3]);
    bytes
}

#[test]
fn a_claimed_length_allocates_no_memory() {
    let layout = Layout::new(Task::Push, 2);
    for n_bytes in [1 << 20, 1 << 31, u64::from(u32::MAX), 1 << 62] {
        for field in 1..16 {
            let bytes = claim(field, n_bytes);
            let allocated = largest(|| {
                assert!(pb::StepQuery::decode(bytes.as_slice()).is_err());
                assert!(pb::AdviseRequest::decode(bytes.as_slice()).is_err());
                assert!(pb::Episode::decode(bytes.as_slice()).is_err());
                assert!(pb::Parameters::decode(bytes.as_slice()).is_err());
                assert!(pb::OpenLeasesRequest::decode(bytes.as_slice()).is_err());
                assert!(pb::SubmitEpisodesRequest::decode(bytes.as_slice()).is_err());
            });
            assert!(
                allocated < 4096,
                "field {field}, {n_bytes} bytes claimed: {allocated} bytes allocated"
            );
        }
    }
    let actor = pb::Parameters {
        version: 1,
        n_hidden: 16_384,
        n_layers: 64,
        actor: vec![0; 64],
        ..pb::Parameters::default()
    };
    let allocated = largest(|| assert!(tandem_proto::decode_actor(&actor, layout).is_err()));
    assert!(
        allocated < 4096,
        "{allocated} bytes allocated for a network of 64 bytes that claims 70 GB"
    );
}
