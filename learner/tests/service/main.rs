//! The learner as a service, with workers that play a toy: what is disturbed must not show.

mod advice;
mod disk;
mod false_claims;
mod metrics;
mod order;
mod refusals;
mod relay;
mod resume;
mod run;
mod silence;
mod teacher;
mod toy;
