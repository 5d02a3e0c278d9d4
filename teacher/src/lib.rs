//! The teacher: a policy for one arm that advises students with several arms, under a budget (section 3.2 of the
//! paper).
//!
//! A student sends the state of a step and the action that it is about to execute. For each arm the teacher computes
//! its own action and the value of both. A [`Strategy`] decides on which arms the teacher's action replaces the
//! student's, and each step with such an arm costs one unit of the student's account.
//!
//! - [`maps`] relates a student's vectors to those of each arm.
//! - [`strategy`] and [`procedures`] decide when an arm is overridden.
//! - [`budget`] defines accounts, leases and charges; [`ledger`] stores them in memory, in a file or on a server.
//! - [`advisor`] combines these with a [`TeacherPolicy`]; [`remote_policy`] is one in another process.
//! - [`service`] serves an [`Advisor`] as `tandem.v1.Teacher`.
//!
//! The first three are pure. The crate does not depend on the student's network, its learning or its simulator.
//!
//! ```
//! use tandem_teacher::budget::{Account, AccountTerms, BudgetHalf, BudgetHalves, Charge};
//!
//! let terms = AccountTerms { budget: 2, strategy: "eamc:0.1".parse()? };
//! let mut account = Account::new(terms);
//! let step = |step| Charge { episode: 7, step, wanted_in: BudgetHalves::BOTH };
//! assert_eq!(account.charge(step(0)), Some(BudgetHalf::First));
//! assert_eq!(account.charge(step(1)), Some(BudgetHalf::Second));
//! assert_eq!(account.charge(step(2)), None, "the budget is spent");
//! assert_eq!(account.charge(step(0)), Some(BudgetHalf::First), "a step is charged once");
//! assert_eq!(account.left(), 0);
//! # Ok::<(), tandem_teacher::UnknownStrategy>(())
//! ```

#![warn(missing_docs)]

pub mod advisor;
mod batch;
pub mod budget;
mod error;
pub mod ledger;
pub mod maps;
pub mod policy;
pub mod procedures;
pub mod remote_policy;
pub mod service;
pub mod strategy;

#[cfg(test)]
mod fake;

pub use advisor::{Advice, AdviceRequest, Advisor, TeacherInfo};
pub use error::Error;
pub use policy::{AnyPolicy, TeacherPolicy};
pub use remote_policy::{PolicyTimeouts, RemoteError, RemotePolicy};
pub use service::{Config, open, serve, serve_advisor};
pub use strategy::{Strategy, UnknownStrategy};
