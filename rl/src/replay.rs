//! The replay buffer: a ring of whole episodes.

use std::borrow::Cow;
use std::ops::Range;

use tandem_core::{ArmIndex, Contacts, Episode, TaskSpec};

/// The replay buffer: whole episodes in flat arrays, episode `e` at `e * stride` of each. A full buffer overwrites the
/// oldest episode.
///
/// # Panics
/// Methods panic if there is no such episode, step or arm.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayBuffer {
    task: TaskSpec,
    capacity_episodes: usize,
    next: usize,
    parts: ReplayParts,
    displaced_episodes: Vec<usize>,
}

/// The contents of a buffer, as a checkpoint stores them; `n_steps` are those of an episode.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ReplayParts {
    /// Shape `[n_episodes, n_steps + 1, n_observation]`.
    pub observations: Vec<f32>,
    /// Shape `[n_episodes, n_goal]`.
    pub goals: Vec<f32>,
    /// Shape `[n_episodes, n_steps, n_action]`.
    pub actions: Vec<f32>,
    /// Shape `[n_episodes, n_steps]`; bit `a` is set if arm `a` executed the teacher's action.
    pub advised_arms: Vec<u8>,
    /// Shape `[n_episodes, n_steps]`, [`Contacts::bits`](tandem_core::Contacts::bits) of the step.
    pub contacts: Vec<u8>,
    /// Shape `[n_episodes]`; 1 if an object was displaced, else 0.
    pub moved: Vec<u8>,
}

impl ReplayBuffer {
    /// Creates an empty buffer for at most `capacity_transitions`, rounded down to whole episodes but at least one.
    #[must_use]
    pub fn new(task: impl Into<TaskSpec>, capacity_transitions: usize) -> Self {
        let task = task.into();
        let capacity_episodes = (capacity_transitions / task.episode_steps()).max(1);
        Self {
            task,
            capacity_episodes,
            next: 0,
            parts: ReplayParts::default(),
            displaced_episodes: Vec::new(),
        }
    }

    /// Restores a buffer from its contents and the index of the next episode; returns `None` if they do not fit
    /// together.
    #[must_use]
    pub fn from_parts(
        task: impl Into<TaskSpec>,
        capacity_transitions: usize,
        parts: ReplayParts,
        next: usize,
    ) -> Option<Self> {
        let mut buffer = Self::new(task, capacity_transitions);
        let task = &buffer.task;
        let has_arms = |arms: u8| (task.n_arms()..8).all(|arm| arms & (1 << arm) == 0);
        let (n, n_steps) = (parts.moved.len(), task.episode_steps());
        // A buffer that is not full grows at its end; a full one wraps around.
        let expected_next = if n < buffer.capacity_episodes { n..n + 1 } else { 0..n };
        let fits = n <= buffer.capacity_episodes
            && expected_next.contains(&next)
            && parts.observations.len() == n * buffer.observation_stride()
            && parts.goals.len() == n * task.n_goal()
            && parts.actions.len() == n * n_steps * task.n_action()
            && parts.advised_arms.len() == n * n_steps
            && parts.contacts.len() == n * n_steps
            && parts.moved.iter().all(|moved| *moved <= 1)
            && parts.advised_arms.iter().all(|arms| has_arms(*arms))
            && parts.contacts.iter().all(|bits| Contacts::from_bits(*bits).is_some());
        if !fits {
            return None;
        }
        buffer.parts = parts;
        buffer.next = next;
        buffer.index_episodes();
        Some(buffer)
    }

    /// Returns the contents, and the index of the next episode.
    #[must_use]
    pub const fn parts(&self) -> (&ReplayParts, usize) {
        (&self.parts, self.next)
    }

    /// Returns the task of the stored episodes.
    #[must_use]
    pub const fn task(&self) -> &TaskSpec {
        &self.task
    }

    /// Returns the number of stored episodes.
    #[must_use]
    pub fn n_episodes(&self) -> usize {
        self.parts.moved.len()
    }

    /// Returns the indices of the stored episodes in which an object was displaced.
    #[must_use]
    pub fn displaced_episodes(&self) -> &[usize] {
        &self.displaced_episodes
    }

    /// Stores an episode, in place of the oldest if the buffer is full.
    ///
    /// # Panics
    /// When the episode belongs to another task.
    pub fn push(&mut self, episode: &Episode) {
        assert_eq!(episode.task, self.task, "an episode of another task");
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

    /// Returns the observation before step `step_idx` of a stored episode, shape `[n_observation]`; `n_steps`
    /// gives the last one.
    #[must_use]
    pub fn observation(&self, episode_idx: usize, step_idx: usize) -> &[f32] {
        let n = self.task.n_observation();
        let start = episode_idx * self.observation_stride() + step_idx * n;
        &self.parts.observations[start..start + n]
    }

    /// Returns what `arm` has achieved before step `step_idx`, in the order of its goal.
    #[must_use]
    pub fn achieved(&self, episode_idx: usize, step_idx: usize, arm: ArmIndex) -> Cow<'_, [f32]> {
        self.task.achieved_goal_of(arm).of(self.observation(episode_idx, step_idx))
    }

    /// Returns the desired goal of a stored episode, shape `[n_goal]`.
    #[must_use]
    pub fn goal(&self, episode_idx: usize) -> &[f32] {
        let n = self.task.n_goal();
        &self.parts.goals[episode_idx * n..(episode_idx + 1) * n]
    }

    /// Returns the action executed on step `step_idx` of a stored episode, shape `[n_action]`.
    #[must_use]
    pub fn action(&self, episode_idx: usize, step_idx: usize) -> &[f32] {
        let n = self.task.n_action();
        let start = (episode_idx * self.task.episode_steps() + step_idx) * n;
        &self.parts.actions[start..start + n]
    }

    /// Returns a mask with bit `a` set if arm `a` executed the teacher's action on that step.
    #[must_use]
    pub fn advised_arms(&self, episode_idx: usize, step_idx: usize) -> u8 {
        self.parts.advised_arms[episode_idx * self.task.episode_steps() + step_idx]
    }

    /// Returns true if an arm touched the other or the table on one of the steps of a stored episode.
    #[must_use]
    pub fn has_contact(&self, steps: Range<usize>, episode_idx: usize) -> bool {
        let start = episode_idx * self.task.episode_steps();
        self.parts.contacts[start + steps.start..start + steps.end].iter().any(|bits| *bits != 0)
    }

    /// Returns the contacts during a step of a stored episode.
    #[must_use]
    pub fn contacts(&self, episode_idx: usize, step_idx: usize) -> Contacts {
        let bits = self.parts.contacts[episode_idx * self.task.episode_steps() + step_idx];
        Contacts::from_bits(bits).unwrap_or(Contacts::NONE)
    }

    /// Returns true if `arm` touched another arm or the table on one of the steps of a stored episode.
    #[must_use]
    pub fn has_contact_of(&self, arm: ArmIndex, steps: Range<usize>, episode_idx: usize) -> bool {
        steps.into_iter().any(|step_idx| self.contacts(episode_idx, step_idx).involves(arm))
    }

    fn observation_stride(&self) -> usize {
        (self.task.episode_steps() + 1) * self.task.n_observation()
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

/// Replaces row `row_idx` of a table with rows of the same length.
fn overwrite<T: Copy>(table: &mut [T], row_idx: usize, row: &[T]) {
    table[row_idx * row.len()..(row_idx + 1) * row.len()].copy_from_slice(row);
}

#[cfg(test)]
pub(crate) mod fixtures {
    use super::*;

    /// Returns an episode in which the object of arm 0 moves by `drift_m` per step along x, and everything else is
    /// zero.
    pub(crate) fn drifting_episode(
        task: impl Into<TaskSpec>,
        number: u64,
        drift_m: f32,
    ) -> Episode {
        let task = task.into();
        let mut episode = Episode::zeros(&task, number);
        let x = task.achieved_goal_of(ArmIndex(0)).index(0);
        let mut position = 0.0;
        for observation in episode.observations.chunks_exact_mut(task.n_observation()) {
            observation[x] = position;
            position += drift_m;
        }
        episode
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;
    use tandem_core::layout::{EPISODE_STEPS, Layout};

    use super::fixtures::drifting_episode;
    use super::*;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);

    #[test]
    fn a_full_buffer_overwrites_the_oldest_episode() {
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
    fn a_buffer_is_restored_from_its_parts() {
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
        let altered = [
            ReplayParts { moved: vec![2, 1], ..parts.clone() },
            ReplayParts { advised_arms: vec![0b100; 2 * EPISODE_STEPS], ..parts.clone() },
            ReplayParts { contacts: vec![0b100; 2 * EPISODE_STEPS], ..parts.clone() },
        ];
        for parts in altered {
            assert_eq!(ReplayBuffer::from_parts(LAYOUT, 2 * EPISODE_STEPS, parts, next), None);
        }
        let of_capacity = |n_episodes, next| {
            ReplayBuffer::from_parts(LAYOUT, n_episodes * EPISODE_STEPS, parts.clone(), next)
        };
        assert_eq!(of_capacity(2, 2), None, "beyond the end of a full one");
        assert_eq!(of_capacity(3, 1), None, "in the middle of one that grows");
        assert!(of_capacity(3, 2).is_some());
    }
}
