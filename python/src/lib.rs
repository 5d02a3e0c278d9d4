//! The compiled part of the Python package `tandem`: environments, pictures of them, policies, and episodes from logs.
//!
//! The package's Python modules give these types the interfaces of Gymnasium and NumPy. Everything here returns the
//! same bits as the Rust crates, because it calls them.

mod episode;
mod log;
mod policy;
mod simulation;
mod task;
mod threads;
mod vector;

use pyo3::prelude::*;

/// The compiled part of the package `tandem`.
#[pymodule]
mod _native {
    #[pymodule_export]
    use super::log::read_episode;
    #[pymodule_export]
    use super::policy::Policy;
    #[pymodule_export]
    use super::simulation::{Simulation, compute_reward};
    #[pymodule_export]
    use super::task::{check_task, task_description};
    #[pymodule_export]
    use super::vector::VectorSimulation;
}
