//! The indices of an arm's numbers within a vector.

use std::borrow::Cow;
use std::ops::Range;

/// The part of a vector that belongs to an arm, as indices in the order of the arm's own vector.
///
/// Indices that are contiguous and ascending are kept as a range, for which no operation copies more than it must.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part(Indices);

#[derive(Debug, Clone, PartialEq, Eq)]
enum Indices {
    Contiguous(Range<usize>),
    Scattered(Vec<usize>),
}

impl Part {
    /// Creates the part with these indices, in this order.
    #[must_use]
    pub fn new(indices: Vec<usize>) -> Self {
        let first = indices.first().copied().unwrap_or(0);
        let contiguous = first..first + indices.len();
        if contiguous.clone().eq(indices.iter().copied()) {
            Self(Indices::Contiguous(contiguous))
        } else {
            Self(Indices::Scattered(indices))
        }
    }

    /// Returns the number of indices.
    #[must_use]
    pub fn len(&self) -> usize {
        match &self.0 {
            Indices::Contiguous(range) => range.len(),
            Indices::Scattered(indices) => indices.len(),
        }
    }

    /// Returns true if the part has no index.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the indices as a range if they are contiguous and ascending.
    #[cfg(test)]
    pub(super) fn as_range(&self) -> Option<Range<usize>> {
        match &self.0 {
            Indices::Contiguous(range) => Some(range.clone()),
            Indices::Scattered(_) => None,
        }
    }

    /// Returns the index, in the whole vector, of number `idx` of the part.
    ///
    /// # Panics
    /// If `idx` is not below [`len`](Self::len).
    #[must_use]
    pub fn index(&self, idx: usize) -> usize {
        match &self.0 {
            Indices::Contiguous(range) => {
                assert!(idx < range.len(), "number {idx} of a part of {}", range.len());
                range.start + idx
            }
            Indices::Scattered(indices) => indices[idx],
        }
    }

    /// Returns the indices in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = usize> {
        (0..self.len()).map(|idx| self.index(idx))
    }

    /// Returns the part's numbers of `vector`, borrowed if they are contiguous.
    ///
    /// # Panics
    /// If the vector is too short.
    #[must_use]
    pub fn of<'a>(&self, vector: &'a [f32]) -> Cow<'a, [f32]> {
        match &self.0 {
            Indices::Contiguous(range) => Cow::Borrowed(&vector[range.clone()]),
            Indices::Scattered(indices) => indices.iter().map(|idx| vector[*idx]).collect(),
        }
    }

    /// Writes `numbers`, one per index, into `vector`.
    ///
    /// # Panics
    /// If the vector is too short or the number of `numbers` differs from [`len`](Self::len).
    pub fn write(&self, vector: &mut [f32], numbers: &[f32]) {
        match &self.0 {
            Indices::Contiguous(range) => vector[range.clone()].copy_from_slice(numbers),
            Indices::Scattered(indices) => {
                assert_eq!(numbers.len(), indices.len(), "numbers of another part");
                for (idx, number) in indices.iter().zip(numbers) {
                    vector[*idx] = *number;
                }
            }
        }
    }

    /// Copies the numbers of `source` at the part `from` into `vector` at this part.
    ///
    /// # Panics
    /// If a vector is too short or the parts differ in length.
    pub fn copy_from(&self, vector: &mut [f32], from: &Self, source: &[f32]) {
        if let (Indices::Contiguous(to), Indices::Contiguous(from)) = (&self.0, &from.0) {
            vector[to.clone()].copy_from_slice(&source[from.clone()]);
            return;
        }
        assert_eq!(self.len(), from.len(), "parts of different lengths");
        for (to, from) in self.iter().zip(from.iter()) {
            vector[to] = source[from];
        }
    }

    /// Writes `number` at every index of the part.
    ///
    /// # Panics
    /// If the vector is too short.
    pub fn fill(&self, vector: &mut [f32], number: f32) {
        match &self.0 {
            Indices::Contiguous(range) => vector[range.clone()].fill(number),
            Indices::Scattered(indices) => indices.iter().for_each(|idx| vector[*idx] = number),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contiguous_indices_are_a_range_and_borrow() {
        let part = Part::new(vec![2, 3, 4]);
        assert_eq!(part.as_range(), Some(2..5));
        assert!(matches!(part.of(&[0.0, 1.0, 2.0, 3.0, 4.0]), Cow::Borrowed([2.0, 3.0, 4.0])));
        for scattered in [vec![2, 4], vec![3, 2], vec![1, 1]] {
            assert_eq!(Part::new(scattered).as_range(), None);
        }
        assert!(Part::new(Vec::new()).is_empty());
    }

    #[test]
    fn scattered_numbers_keep_the_order_of_the_indices() {
        let part = Part::new(vec![4, 0, 2]);
        let mut vector = [0.0, 1.0, 2.0, 3.0, 4.0];
        assert_eq!(*part.of(&vector), [4.0, 0.0, 2.0]);
        part.write(&mut vector, &[7.0, 8.0, 9.0]);
        assert_eq!(vector, [8.0, 1.0, 9.0, 3.0, 7.0]);
        part.fill(&mut vector, -1.0);
        assert_eq!(vector, [-1.0, 1.0, -1.0, 3.0, -1.0]);
    }

    #[test]
    fn a_part_is_copied_between_vectors() {
        let source = [10.0, 11.0, 12.0, 13.0];
        for (to, from, expected) in [
            (vec![0, 1], vec![2, 3], [12.0, 13.0, 0.0]),
            (vec![2, 0], vec![1, 2], [12.0, 0.0, 11.0]),
            (vec![1, 2], vec![3, 0], [0.0, 13.0, 10.0]),
        ] {
            let mut vector = [0.0; 3];
            Part::new(to).copy_from(&mut vector, &Part::new(from), &source);
            assert_eq!(vector, expected);
        }
    }
}
