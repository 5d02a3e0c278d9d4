//! The command line of `tandem bridge trial`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use crate::cli::TaskName;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem bridge trial --policy policies/student-push.safetensors
  tandem bridge trial --policy policies/student-pick-and-place.safetensors --mode closed-loop --trials 200 --seed 3
  tandem bridge trial --policy policies/student-push.safetensors --composed-teachers policies/teacher-push.safetensors
  tandem report runs/trial-push")]
#[command(group = clap::ArgGroup::new("who").required(true).multiple(true))]
pub(crate) struct TrialArgs {
    /// A policy for both arms, tried under the name of its file or run directory; may be repeated.
    #[arg(long = "policy", value_name = "FILE", group = "who")]
    pub(crate) policies: Vec<PathBuf>,
    /// A one-arm policy that drives each arm by itself; may be repeated.
    #[arg(long, value_name = "FILE", group = "who")]
    pub(crate) composed_teachers: Vec<PathBuf>,
    /// Must be the policies' task, when given.
    #[arg(long, value_enum)]
    pub(crate) task: Option<TaskName>,
    /// Trials of each policy.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pub(crate) trials: u64,
    /// Whether the policy sees the table before each step, or a rehearsed motion is carried out blind; may be repeated
    /// [default: all].
    #[arg(long = "mode", value_enum, value_name = "MODE")]
    pub(crate) modes: Vec<ModeName>,
    /// Decides starts, goals and the arms' noise: the same for every policy and mode.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Share of the fastest speed, more than 0 and at most 1.
    #[arg(long, default_value_t = 1.0)]
    pub(crate) speed: f64,
    /// Edge of the blocks, in cm; the training world's have 4.5, the paper's arms pushed 9.
    #[arg(long, default_value_t = 5.6)]
    pub(crate) block_cm: f32,
    /// Which trials leave an MCAP log.
    #[arg(long, value_enum, default_value_t = RecordName::Failures)]
    pub(crate) record: RecordName,
    /// Leaves each trial's motion as a file for `tandem bridge move`.
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
    /// A look at the table before every step.
    ClosedLoop,
    /// Blind, rehearsed in the training world: the paper's way.
    OpenLoop,
    /// Blind, rehearsed on a copy of the pair.
    Twin,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RecordName {
    /// Every trial.
    All,
    /// Those that fail.
    Failures,
    /// No trial.
    None,
}
