//! Access to the networks and their optimisers, for checkpoints and policies.

use std::borrow::Cow;

use tandem_policy::{MlpShape, Policy};

use super::{Ddpg, DdpgConfig, DdpgError};

/// A batch of the student's critic.
#[derive(Debug, Clone, Copy)]
pub struct CriticBatch<'a> {
    /// Normalised observation, normalised goal and executed action, shape `[b, n_observation + n_goal + n_action]`.
    pub inputs: &'a [f32],
    /// Targets `y` of equation 5 of the paper, shape `[b, n_heads]`.
    pub targets: &'a [f32],
}

impl Ddpg {
    /// Returns the settings.
    #[must_use]
    pub const fn config(&self) -> &DdpgConfig {
        &self.config
    }

    /// Returns the number of updates so far.
    #[must_use]
    pub const fn n_updates(&self) -> u64 {
        self.n_updates
    }

    /// Returns the shape of the actor.
    #[must_use]
    pub const fn actor_shape(&self) -> &MlpShape {
        &self.actor.shape
    }

    /// Returns the shape of the critic.
    #[must_use]
    pub const fn critic_shape(&self) -> &MlpShape {
        &self.critic.shape
    }

    /// Returns the actor's parameters, shape `[n_parameters]` of [`actor_shape`](Self::actor_shape).
    #[must_use]
    pub fn actor(&self) -> &[f32] {
        &self.actor.online
    }

    /// Returns the parameters of the actor's target network, of the same shape.
    #[must_use]
    pub fn target_actor(&self) -> Vec<f32> {
        self.actor.target()
    }

    /// Returns the critic's parameters, shape `[n_parameters]` of [`critic_shape`](Self::critic_shape).
    #[must_use]
    pub fn critic(&self) -> &[f32] {
        &self.critic.online
    }

    /// Returns the parameters of the critic's target network, of the same shape.
    #[must_use]
    pub fn target_critic(&self) -> Vec<f32> {
        self.critic.target()
    }

    /// Returns the critic's inputs and targets in the last update.
    #[must_use]
    pub fn critic_batch(&self) -> CriticBatch<'_> {
        CriticBatch { inputs: &self.critic_update.input, targets: &self.critic_update.targets }
    }

    /// Returns the gradients of the losses with respect to the parameters in the last update: the actor's and the
    /// critic's.
    #[must_use]
    pub fn gradients(&self) -> [&[f32]; 2] {
        [&self.actor.gradient, &self.critic.gradient]
    }

    /// Initialises all networks, online and target, with those of a policy. Intended for a learner that has made no
    /// update.
    ///
    /// # Panics
    /// When the policy's networks have other sizes.
    pub fn start_from(&mut self, policy: &Policy) {
        self.actor.set(&policy.actor, &policy.actor);
        self.critic.set(&policy.critic, &policy.critic);
    }

    /// Every vector that the next update depends on, by name, in a fixed order. With [`Ddpg::n_updates`] it is the
    /// whole state.
    #[must_use]
    pub fn state(&self) -> [(&'static str, Cow<'_, [f32]>); 8] {
        let [actor_first, actor_second] = self.actor.adam.moments();
        let [critic_first, critic_second] = self.critic.adam.moments();
        [
            ("actor.online", Cow::from(&*self.actor.online)),
            ("actor.target", Cow::from(self.actor.target())),
            ("actor.adam.first", Cow::from(actor_first)),
            ("actor.adam.second", Cow::from(actor_second)),
            ("critic.online", Cow::from(&*self.critic.online)),
            ("critic.target", Cow::from(self.critic.target())),
            ("critic.adam.first", Cow::from(critic_first)),
            ("critic.adam.second", Cow::from(critic_second)),
        ]
    }

    /// Restores the vectors and the count returned by [`Ddpg::state`] and [`Ddpg::n_updates`].
    ///
    /// # Errors
    /// When a vector is missing or has another length. The learner is unchanged then.
    pub fn restore(
        &mut self,
        stored: &[(String, Vec<f32>)],
        n_updates: u64,
    ) -> Result<(), DdpgError> {
        let mut vectors: [&[f32]; 8] = [&[]; 8];
        for ((name, now), vector) in self.state().into_iter().zip(&mut vectors) {
            let found = stored
                .iter()
                .find(|(stored_name, _)| stored_name == name)
                .map(|(_, found)| found.as_slice());
            let (got, expected) = (found.map_or(0, <[f32]>::len), now.len());
            *vector = found.filter(|_| got == expected).ok_or(DdpgError::Restore {
                name,
                got,
                expected,
            })?;
        }
        let [
            actor,
            target_actor,
            actor_first,
            actor_second,
            critic,
            target_critic,
            critic_first,
            critic_second,
        ] = vectors;
        self.actor.set(actor, target_actor);
        self.actor.adam.restore(n_updates, [actor_first, actor_second]);
        self.critic.set(critic, target_critic);
        self.critic.adam.restore(n_updates, [critic_first, critic_second]);
        self.n_updates = n_updates;
        Ok(())
    }

    /// Returns the floating-point operations of an update's matrix products, two per multiply-add. It counts the
    /// necessary ones: five forward passes, the gradients of critic and actor, and the backward pass through the critic
    /// to the action.
    #[must_use]
    pub const fn flops_per_update(&self) -> u64 {
        let (actor, critic) = (&self.actor.shape, &self.critic.shape);
        let critic_above_input = products(critic) - critic.n_input * critic.layer_output(0);
        let actor_above_input = products(actor) - actor.n_input * actor.layer_output(0);
        let forward = 2 * products(actor) + 3 * products(critic);
        let critic_backward = products(critic) + critic_above_input;
        let action_backward = critic_above_input + actor.n_output * critic.layer_output(0);
        let actor_backward = products(actor) + actor_above_input;
        let per_row = forward + critic_backward + action_backward + actor_backward;
        2 * (self.config.transitions_per_update() * per_row) as u64
    }
}

/// Returns the multiply-adds of one row's forward pass.
const fn products(shape: &MlpShape) -> usize {
    let mut sum = 0;
    let mut layer = 0;
    while layer < shape.n_layers() {
        sum += shape.layer_input(layer) * shape.layer_output(layer);
        layer += 1;
    }
    sum
}
