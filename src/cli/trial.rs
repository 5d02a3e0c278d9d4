//! The command line of `tandem bridge trial`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use tandem_trials::simulated::GripperConfig;

use crate::cli::{TaskName, WorldName};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem bridge trial --policy policies/student-push.safetensors
  tandem bridge trial --policy policies/student-pick-and-place.safetensors \\
      --mode closed-loop --trials 200 --seed 3
  tandem bridge trial --policy policies/student-push.safetensors \\
      --composed-teachers policies/teacher-push.safetensors
  tandem bridge trial --task carry-bar --mode closed-loop \\
      --composed-teachers policies/teacher-pick-and-place-classic.safetensors
  tandem report runs/trial-shared-push")]
#[command(group = clap::ArgGroup::new("who").required(true).multiple(true))]
pub(crate) struct TrialArgs {
    /// Policy for both arms, a file or a run directory, reported under its name; can be repeated.
    #[arg(long = "policy", value_name = "FILE|DIR", group = "who")]
    pub(crate) policies: Vec<PathBuf>,
    /// One-arm policy that controls each arm separately, in the task of the other policies or of --task if it performs one
    /// arm's part of that; can be repeated.
    #[arg(long, value_name = "FILE|DIR", group = "who")]
    pub(crate) composed_teachers: Vec<PathBuf>,
    /// Fails unless the policies are for this task.
    #[arg(long, value_parser = TaskName::parser())]
    pub(crate) task: Option<TaskName>,
    /// Fails unless the policies are for this world.
    #[arg(long, value_enum)]
    pub(crate) world: Option<WorldName>,
    /// Number of trials per policy.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pub(crate) trials: u64,
    /// Closed loop (the policy observes the table before each step) or open loop (a precomputed motion is executed);
    /// can be repeated [default: all].
    #[arg(long = "mode", value_enum, value_name = "MODE")]
    pub(crate) modes: Vec<ModeName>,
    /// Seed of starts, goals and the arms' noise, the same for all policies and modes.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Largest number of rehearsals of an open loop in the training world and, if none is robust, in the closed loop on
    /// copies of the pair. The most robust one is executed. 1 is the paper's method: a single one, in the training world.
    /// An object that both arms share is rehearsed once.
    #[arg(long, value_name = "N", default_value_t = 16,
        value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub(crate) rehearsals: u32,
    /// Fraction of the highest speed, 0.01 to 1.
    #[arg(long, default_value_t = 1.0)]
    pub(crate) speed: f64,
    /// Edge of the blocks in cm; 4.5 to 6.5 in the training of students of the shared world, 4.5 in that of the classic
    /// world, 9 in the paper's trials. An object that both arms share keeps its size [default: 5.6].
    #[arg(long)]
    pub(crate) block_cm: Option<f32>,
    /// Coulomb friction of the grippers' pads, 0 to 2. Blocks have 0.5, and a contact has the larger of both.
    #[arg(long, value_name = "COEFFICIENT", default_value_t = GripperConfig::default().pad_friction)]
    pub(crate) pad_friction: f32,
    /// Trials to record to MCAP files.
    #[arg(long, value_enum, default_value_t = RecordName::Failures)]
    pub(crate) record: RecordName,
    /// Writes the motion of each trial to a file for `tandem bridge move`, except those of more than 999 waypoints.
    #[arg(long)]
    pub(crate) motions: bool,
    /// Directory for trials.jsonl and the logs [default: runs/trial-TASK].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Prints one JSON object on the last line of standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ModeName {
    /// Closed loop: the policy observes the table before each step.
    ClosedLoop,
    /// Open loop, rehearsed in the training world and on copies of the pair.
    OpenLoop,
    /// Open loop, precomputed on a copy of the simulated pair.
    Twin,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RecordName {
    /// All trials.
    All,
    /// Failed trials.
    Failures,
    /// None.
    None,
}
