//! Vectors that start at a cache line.

use std::ops::{Deref, DerefMut};

/// Bytes of a cache line, and of the widest vector register.
const CACHE_LINE: usize = 64;
/// Numbers of a cache line.
const NUMBERS: usize = CACHE_LINE / size_of::<f32>();

/// A vector of numbers that starts at a cache line, so that no load of a register touches two lines.
///
/// The alignment affects the time of matrix products that read their operands in place, and never a result.
#[derive(Debug)]
pub struct AlignedVec {
    memory: Vec<f32>,
    start: usize,
    len: usize,
}

impl AlignedVec {
    /// Allocates `len` zeros.
    #[must_use]
    pub fn zeros(len: usize) -> Self {
        let memory = vec![0.0; len + NUMBERS - 1];
        let start = memory.as_ptr().align_offset(CACHE_LINE).min(NUMBERS - 1);
        Self { memory, start, len }
    }
}

impl From<&[f32]> for AlignedVec {
    fn from(numbers: &[f32]) -> Self {
        let mut aligned = Self::zeros(numbers.len());
        aligned.copy_from_slice(numbers);
        aligned
    }
}

impl Clone for AlignedVec {
    fn clone(&self) -> Self {
        Self::from(&**self)
    }
}

impl PartialEq for AlignedVec {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl Deref for AlignedVec {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.memory[self.start..self.start + self.len]
    }
}

impl DerefMut for AlignedVec {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.memory[self.start..self.start + self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vector_and_its_copy_have_the_same_numbers_and_start_at_a_cache_line() {
        for len in [0, 1, 1000] {
            let numbers: Vec<f32> = (0..len).map(|i| i as f32).collect();
            let aligned = AlignedVec::from(&*numbers);
            for aligned in [aligned.clone(), aligned] {
                assert_eq!(*aligned, *numbers);
                assert_eq!(aligned.as_ptr().addr() % CACHE_LINE, 0);
            }
        }
    }
}
