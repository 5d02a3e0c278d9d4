//! The replay buffer: whole episodes, the oldest overwritten first.

use std::ops::Range;

use tandem_core::layout::{ArmIndex, EPISODE_STEPS, Layout};
use tandem_core::{Contacts, Episode, EpisodeKind};

/// Whole episodes in flat arrays; episode `e` of `n` lies at `e * stride` of each.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayBuffer {
    layout: Layout,
    capacity_episodes: usize,
    next: usize,
    parts: ReplayParts,
    displaced_episodes: Vec<usize>,
}

/// The buffer's contents as they are stored.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ReplayParts {
    /// Shape `[n_episodes, EPISODE_STEPS + 1, n_observation]`.
    pub observations: Vec<f32>,
    /// Shape `[n_episodes, n_goal]`.
    pub goals: Vec<f32>,
    /// Shape `[n_episodes, EPISODE_STEPS, n_action]`.
    pub actions: Vec<f32>,
    /// Shape `[n_episodes, EPISODE_STEPS]`, bit `a`: arm `a` executed the teacher's action.
    pub advised_arms: Vec<u8>,
    /// Shape `[n_episodes, EPISODE_STEPS]`, [`Contacts::bits`] of the step.
    pub contacts: Vec<u8>,
    /// Shape `[n_episodes]`, 1 where an object was displaced.
    pub moved: Vec<u8>,
}

impl ReplayBuffer {
    /// An empty buffer for at most `capacity_transitions`, rounded down to whole episodes but at least one.
    #[must_use]
    pub fn new(layout: Layout, capacity_transitions: usize) -> Self {
        let capacity_episodes = (capacity_transitions / EPISODE_STEPS).max(1);
        Self {
            layout,
            capacity_episodes,
            next: 0,
            parts: ReplayParts::default(),
            displaced_episodes: Vec::new(),
        }
    }

    /// A buffer with stored contents; `next` is where the next episode goes.
    #[must_use]
    pub fn from_parts(
        layout: Layout,
        capacity_transitions: usize,
        parts: ReplayParts,
        next: usize,
    ) -> Option<Self> {
        let mut buffer = Self::new(layout, capacity_transitions);
        let n = parts.moved.len();
        // A buffer that is not full grows at its end; a full one goes round.
        let expected_next = if n < buffer.capacity_episodes { n..n + 1 } else { 0..n };
        let fits = n <= buffer.capacity_episodes
            && expected_next.contains(&next)
            && parts.observations.len() == n * buffer.observation_stride()
            && parts.goals.len() == n * layout.n_goal()
            && parts.actions.len() == n * EPISODE_STEPS * layout.n_action()
            && parts.advised_arms.len() == n * EPISODE_STEPS
            && parts.contacts.len() == n * EPISODE_STEPS;
        if !fits {
            return None;
        }
        buffer.parts = parts;
        buffer.next = next;
        buffer.index_episodes();
        Some(buffer)
    }

    /// What is stored, and where the next episode goes.
    #[must_use]
    pub const fn parts(&self) -> (&ReplayParts, usize) {
        (&self.parts, self.next)
    }

    /// Tasks and arms of the stored episodes.
    #[must_use]
    pub const fn layout(&self) -> Layout {
        self.layout
    }

    /// How many episodes are stored.
    #[must_use]
    pub fn n_episodes(&self) -> usize {
        self.parts.moved.len()
    }

    /// The stored episodes in which an object was displaced.
    #[must_use]
    pub fn displaced_episodes(&self) -> &[usize] {
        &self.displaced_episodes
    }

    /// Stores an episode, in the place of the oldest when the buffer is full.
    ///
    /// # Panics
    /// When the episode is of another layout.
    pub fn push(&mut self, episode: &Episode) {
        assert_eq!(episode.layout, self.layout, "an episode of another layout");
        let moved = u8::from(episode.moved());
        let contacts: Vec<u8> = episode.contacts.iter().map(|contacts| contacts.bits()).collect();
        let parts = &mut self.parts;
        if parts.moved.len() < self.capacity_episodes {
            parts.observations.extend_from_slice(&episode.observations);
            parts.goals.extend_from_slice(&episode.goal);
            parts.actions.extend_from_slice(&episode.actions);
            parts.advised_arms.extend_from_slice(&episode.advised_arms);
            parts.contacts.extend_from_slice(&contacts);
            parts.moved.push(moved);
            if moved == 1 {
                self.displaced_episodes.push(self.next);
            }
        } else {
            overwrite(&mut parts.observations, self.next, &episode.observations);
            overwrite(&mut parts.goals, self.next, &episode.goal);
            overwrite(&mut parts.actions, self.next, &episode.actions);
            overwrite(&mut parts.advised_arms, self.next, &episode.advised_arms);
            overwrite(&mut parts.contacts, self.next, &contacts);
            parts.moved[self.next] = moved;
            self.index_episodes();
        }
        self.next = (self.next + 1) % self.capacity_episodes;
    }

    /// The observation before step `step_idx` of a stored episode; `EPISODE_STEPS` gives the last.
    #[must_use]
    pub fn observation(&self, episode_idx: usize, step_idx: usize) -> &[f32] {
        let n = self.layout.n_observation();
        let start = episode_idx * self.observation_stride() + step_idx * n;
        &self.parts.observations[start..start + n]
    }

    /// Where `arm`'s object is before step `step_idx`, in the arm's own frame, metres.
    #[must_use]
    pub fn achieved(&self, episode_idx: usize, step_idx: usize, arm: ArmIndex) -> &[f32] {
        &self.observation(episode_idx, step_idx)[self.layout.achieved_goal_of(arm)]
    }

    /// A stored episode's desired goal.
    #[must_use]
    pub fn goal(&self, episode_idx: usize) -> &[f32] {
        let n = self.layout.n_goal();
        &self.parts.goals[episode_idx * n..(episode_idx + 1) * n]
    }

    /// The action executed on step `step_idx` of a stored episode.
    #[must_use]
    pub fn action(&self, episode_idx: usize, step_idx: usize) -> &[f32] {
        let n = self.layout.n_action();
        let start = (episode_idx * EPISODE_STEPS + step_idx) * n;
        &self.parts.actions[start..start + n]
    }

    /// Bit `a` set where arm `a` executed the teacher's action on that step.
    #[must_use]
    pub fn advised_arms(&self, episode_idx: usize, step_idx: usize) -> u8 {
        self.parts.advised_arms[episode_idx * EPISODE_STEPS + step_idx]
    }

    /// Whether an arm touched the other or the table on one of the steps of an episode.
    #[must_use]
    pub fn has_contact(&self, steps: Range<usize>, episode_idx: usize) -> bool {
        let start = episode_idx * EPISODE_STEPS;
        self.parts.contacts[start + steps.start..start + steps.end].iter().any(|bits| *bits != 0)
    }

    const fn observation_stride(&self) -> usize {
        (EPISODE_STEPS + 1) * self.layout.n_observation()
    }

    fn index_episodes(&mut self) {
        self.displaced_episodes.clear();
        let moved = self
            .parts
            .moved
            .iter()
            .enumerate()
            .filter(|(_, moved)| **moved == 1)
            .map(|(episode, _)| episode);
        self.displaced_episodes.extend(moved);
    }
}

/// Puts `row` in the place of row `row_idx` of a table with rows of that length.
fn overwrite<T: Copy>(table: &mut [T], row_idx: usize, row: &[T]) {
    table[row_idx * row.len()..(row_idx + 1) * row.len()].copy_from_slice(row);
}

/// An episode of zeros, for benchmarks and tests: the object of arm 0 drifts by `drift_m` a step along x.
#[must_use]
pub fn drifting_episode(layout: Layout, number: u64, drift_m: f32) -> Episode {
    let n_observation = layout.n_observation();
    let mut observations = vec![0.0; (EPISODE_STEPS + 1) * n_observation];
    let x = layout.achieved_goal_of(ArmIndex(0)).start;
    let mut position = 0.0;
    for observation in observations.chunks_exact_mut(n_observation) {
        observation[x] = position;
        position += drift_m;
    }
    Episode {
        number,
        kind: EpisodeKind::Training,
        parameter_version: 0,
        layout,
        observations,
        goal: vec![0.0; layout.n_goal()],
        actions: vec![0.0; EPISODE_STEPS * layout.n_action()],
        advised_arms: vec![0; EPISODE_STEPS],
        contacts: vec![Contacts::NONE; EPISODE_STEPS],
        advice_charged: 0,
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);

    #[test]
    fn the_oldest_episode_gives_way() {
        let mut buffer = ReplayBuffer::new(LAYOUT, 3 * EPISODE_STEPS);
        for number in 0_u8..5 {
            let drift_m = if number % 2 == 0 { 0.0 } else { 0.01 * f32::from(number) };
            buffer.push(&drifting_episode(LAYOUT, u64::from(number), drift_m));
        }
        let second_x: Vec<f32> =
            (0..3).map(|episode| buffer.achieved(episode, 1, ArmIndex(0))[0]).collect();
        assert_eq!(second_x, [0.03, 0.0, 0.0], "episodes 3, 4, 2");
        assert_eq!(buffer.displaced_episodes(), [0]);
    }

    #[test]
    fn a_buffer_survives_being_taken_apart() {
        let mut buffer = ReplayBuffer::new(LAYOUT, 2 * EPISODE_STEPS);
        for number in 0..3 {
            buffer.push(&drifting_episode(LAYOUT, number, 0.02));
        }
        let (parts, next) = buffer.parts();
        assert_eq!(
            ReplayBuffer::from_parts(LAYOUT, 2 * EPISODE_STEPS, parts.clone(), next),
            Some(buffer.clone())
        );
        let mut torn = parts.clone();
        torn.actions.pop();
        assert_eq!(ReplayBuffer::from_parts(LAYOUT, 2 * EPISODE_STEPS, torn, next), None);
        let of_capacity = |n_episodes, next| {
            ReplayBuffer::from_parts(LAYOUT, n_episodes * EPISODE_STEPS, parts.clone(), next)
        };
        assert_eq!(of_capacity(2, 2), None, "beyond the end of a full one");
        assert_eq!(of_capacity(3, 1), None, "in the middle of one that grows");
        assert!(of_capacity(3, 2).is_some());
    }
}
