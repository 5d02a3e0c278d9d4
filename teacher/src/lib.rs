//! The teacher: a policy for one arm that advises students with several, under a budget.
//!
//! Section 3.2 of the paper. Everything that decides is pure and tested without a network: [`maps`] says which of a
//! student's numbers belong to which arm, [`strategy`] and [`procedures`] when the teacher's action replaces the
//! student's, [`budget`] what that costs. [`Advisor`] puts them together with a [`TeacherPolicy`]; [`service`] offers
//! it as `tandem.v1.Teacher`. The student's network, its learning and its episodes are not known here.

pub mod advisor;
pub mod budget;
mod error;
pub mod ledger;
pub mod maps;
pub mod policy;
pub mod procedures;
pub mod service;
pub mod strategy;

#[cfg(test)]
mod fake;

pub use advisor::{Advice, Advisor, Profile, Question};
pub use error::Error;
pub use policy::TeacherPolicy;
pub use service::{Config, open, serve, serve_advisor};
pub use strategy::{Strategy, UnknownStrategy};
