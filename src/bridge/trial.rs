//! `tandem bridge trial`: policies on the simulated pair, judged by where the objects are.

use std::path::{Path, PathBuf};

use indicatif::ProgressBar;
use rayon::iter::{IntoParallelIterator as _, IntoParallelRefIterator as _, ParallelIterator as _};
use serde_json::json;
use tandem_core::{Layout, Task};
use tandem_kinematics::Joints;
use tandem_policy::{Actor, Policy};
use tandem_report::{Comparison, Pictured, report_html};
use tandem_telemetry::trial_log::{TrialLook, TrialMetadata, TrialOutcome, TrialRecorder};
use tandem_telemetry::trials::TRIALS_FILE;
use tandem_telemetry::{ToolsAt, TrialRow, TrialsLog};
use tandem_trials::SimulatedConfig;
use tandem_trials::simulated::Block;
use tandem_trials::trial::{
    Look, Mode, NoWitness, TrialConfig, TrialError, TrialReport, Trials, Witness,
};

use crate::bridge::file;
use crate::cli::{ModeName, RecordName, TrialArgs};
use crate::eval::task;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::files::load_policy;
use crate::output;

/// Density of the blocks, kilograms per cubic metre: a block of 5.6 cm has 0.12 kg.
const DENSITY_KGPM3: f32 = 683.3;
/// Lightest and heaviest block, kilograms.
const MASS_KG: [f32; 2] = [0.05, 0.25];
/// Smallest and largest block, centimetres: what the training world knows.
const BLOCK_CM: [f32; 2] = [3.0, 9.0];
/// Longest trial, seconds.
const TIME_LIMIT_S: f64 = 120.0;
/// Points of the tools' way that a row keeps at most.
const PATH_POINTS: usize = 150;

const NO_WORLD: &str = "there is no training world for these blocks";

/// Somebody whose trials these are.
struct Subject {
    name: String,
    policy: Policy,
}

/// One policy in one mode.
struct Series<'a> {
    subject: &'a Subject,
    config: TrialConfig,
}

pub(crate) fn trial(args: &TrialArgs) -> Result<(), Failed> {
    let (task, subjects) = subjects(args)?;
    let block = block(args.block_cm)?;
    if !(args.speed > 0.0 && args.speed <= 1.0) {
        let told = format!("--speed {}: expected more than 0 and at most 1", args.speed);
        return Err(Failed::usage(told));
    }
    let all_modes = [ModeName::ClosedLoop, ModeName::Twin, ModeName::OpenLoop];
    let modes = if args.modes.is_empty() { &all_modes[..] } else { &args.modes };
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from(format!("runs/trial-{task}")));
    for directory in ["mcap", "motions"] {
        std::fs::create_dir_all(out.join(directory))
            .or_cannot_write(|| format!("cannot create {}", out.display()))?;
    }
    let file = out.join(TRIALS_FILE);
    let mut log = TrialsLog::create(&file).or_cannot_write(String::new)?;
    let mut all = Vec::new();
    for subject in &subjects {
        for mode in modes {
            let config = TrialConfig {
                layout: Layout::new(task, 2),
                mode: mode_of(*mode),
                block,
                seed: args.seed,
                speed: args.speed,
                simulated: SimulatedConfig::default(),
                time_limit_s: TIME_LIMIT_S,
            };
            let series = Series { subject, config };
            let rows = series.run(args, &out)?;
            for row in &rows {
                log.append(row).or_exit(Exit::TryAgain, String::new)?;
            }
            series.record(&rows, &out)?;
            all.extend(rows);
        }
    }
    show(args, all, &file)
}

const fn mode_of(name: ModeName) -> Mode {
    match name {
        ModeName::ClosedLoop => Mode::ClosedLoop,
        ModeName::OpenLoop => Mode::OpenLoop,
        ModeName::Twin => Mode::Twin,
    }
}

/// The task, and everybody who is to do it.
fn subjects(args: &TrialArgs) -> Result<(Task, Vec<Subject>), Failed> {
    let mut subjects = Vec::new();
    for path in &args.policies {
        let policy = load_policy(path)?;
        if policy.layout.n_arms != 2 {
            return Err(Failed::usage(format!(
                "{} drives {} arm(s), the bridge has 2: a one-arm policy goes with --composed-teachers",
                path.display(),
                policy.layout.n_arms
            )));
        }
        subjects.push(Subject { name: name_of(path), policy });
    }
    for path in &args.composed_teachers {
        let policy = load_policy(path)?;
        if policy.layout.n_arms != 1 {
            return Err(Failed::usage(format!(
                "{} drives {} arms: a teacher drives one",
                path.display(),
                policy.layout.n_arms
            )));
        }
        subjects.push(Subject { name: format!("composed-{}", name_of(path)), policy });
    }
    let found = |subject: &Subject| subject.policy.layout.task;
    let wanted = args.task.map(task);
    let first = wanted.or_else(|| subjects.first().map(found));
    let Some(task) = first else {
        return Err(Failed::usage("give --policy or --composed-teachers"));
    };
    match subjects.iter().find(|subject| found(subject) != task) {
        Some(other) => {
            let told = format!("{} is for {}, not {task}", other.name, found(other));
            Err(Failed::usage(told))
        }
        None => Ok((task, subjects)),
    }
}

fn block(edge_cm: f32) -> Result<Block, Failed> {
    let [low, high] = BLOCK_CM;
    if !(low..=high).contains(&edge_cm) {
        return Err(Failed::usage(format!("--block-cm {edge_cm}: expected {low} to {high}")));
    }
    let half_m = 0.005 * edge_cm;
    let mass_kg = DENSITY_KGPM3 * (2.0 * half_m).powi(3);
    let mass_kg = mass_kg.clamp(MASS_KG[0], MASS_KG[1]);
    Ok(Block { half_m, mass_kg, ..Block::small([0.0; 2]) })
}

impl Series<'_> {
    /// Every trial, by number. Trials do not know of each other, so that it does not matter how many cores there are.
    fn run(&self, args: &TrialArgs, out: &Path) -> Result<Vec<TrialRow>, Failed> {
        let label = format!("{}, {}", self.subject.name, self.config.mode.name());
        let bar = ProgressBar::new(args.trials).with_prefix(label);
        let style = indicatif::ProgressStyle::with_template("{prefix} {wide_bar} {pos} of {len}");
        let bar = bar.with_style(style.or_exit(Exit::Bug, String::new)?);
        let actor = self.subject.policy.actor().or_exit(Exit::Data, String::new)?;
        let rows: Result<Vec<TrialRow>, Failed> = (0..args.trials)
            .into_par_iter()
            .map_init(
                || (self.trials().ok(), actor.clone()),
                |(trials, actor), number| {
                    let trials = trials.as_mut().ok_or_else(no_world)?;
                    let row = self.one(trials, actor, number, args, out)?;
                    bar.inc(1);
                    Ok(row)
                },
            )
            .collect();
        bar.finish_and_clear();
        rows
    }

    fn one(
        &self,
        trials: &mut Trials,
        actor: &mut Actor,
        number: u64,
        args: &TrialArgs,
        out: &Path,
    ) -> Result<TrialRow, Failed> {
        let report = attempt(trials, actor, number, &mut NoWitness)?;
        let mut row = self.row(&report);
        let name = format!("{}-{}-{number:04}", row.subject, row.mode);
        if args.motions && !report.way_points.is_empty() {
            let path = out.join(format!("motions/{name}.json"));
            file::write(&path, self.config.speed, &report.way_points)?;
        }
        let wanted = match args.record {
            RecordName::All => true,
            RecordName::Failures => !row.success,
            RecordName::None => false,
        };
        row.log = wanted.then(|| format!("mcap/{name}.mcap"));
        Ok(row)
    }

    /// Plays every trial that shall have a log once more: it takes the same course.
    fn record(&self, rows: &[TrialRow], out: &Path) -> Result<(), Failed> {
        let actor = self.subject.policy.actor().or_exit(Exit::Data, String::new)?;
        rows.par_iter().filter(|row| row.log.is_some()).try_for_each(|row| {
            let Some(name) = &row.log else { return Ok(()) };
            let recorder = TrialRecorder::create(&out.join(name), &self.metadata(row.trial))
                .or_cannot_write(String::new)?;
            let mut recording = Recording { recorder, failure: None };
            let mut trials = self.trials()?;
            attempt(&mut trials, &mut actor.clone(), row.trial, &mut recording)?;
            recording.finish(row)
        })
    }

    fn trials(&self) -> Result<Trials, Failed> {
        Trials::new(self.config.clone()).or_exit(Exit::Bug, || NO_WORLD.to_owned())
    }

    fn metadata(&self, number: u64) -> TrialMetadata {
        TrialMetadata {
            subject: self.subject.name.clone(),
            layout: self.config.layout,
            mode: self.config.mode.name().to_owned(),
            trial: number,
            seed: self.config.seed,
            policy_digest: self.subject.policy.digest(),
            driver: "sim".to_owned(),
            speed: self.config.speed,
            block_half_m: f64::from(self.config.block.half_m),
        }
    }

    fn row(&self, report: &TrialReport) -> TrialRow {
        let distances = report.objects.iter().map(|object| object.goal_distance_m());
        let every = report.path.len().div_ceil(PATH_POINTS).max(1);
        TrialRow {
            subject: self.subject.name.clone(),
            mode: self.config.mode.name().to_owned(),
            task: self.config.layout.task.name().to_owned(),
            trial: report.number,
            seed: self.config.seed,
            success: report.cause.is_none(),
            cause: report.cause.as_ref().map(|cause| cause.name().to_owned()),
            detail: report.cause.as_ref().and_then(|cause| cause.detail()),
            goal_distances_m: distances.collect(),
            rehearsed_m: report.rehearsed_m.clone(),
            duration_s: report.duration_s,
            n_steps: report.n_steps as u64,
            n_shortened: report.n_shortened as u64,
            arms_gap_m: report.arms_gap_m.is_finite().then_some(report.arms_gap_m),
            table_gap_m: report.table_gap_m,
            starts: report.places.iter().map(|places| places.start.to_array()).collect(),
            goals: report.places.iter().map(|places| places.goal.to_array()).collect(),
            ends: report.places.iter().map(|places| places.end.to_array()).collect(),
            path: report.path.iter().step_by(every).map(tools_at).collect(),
            log: None,
        }
    }
}

fn no_world() -> Failed {
    Failed::new(Exit::Bug, anyhow::anyhow!(NO_WORLD))
}

/// Carries out a trial that somebody may watch.
fn attempt(
    trials: &mut Trials,
    actor: &mut Actor,
    number: u64,
    witness: &mut dyn Witness,
) -> Result<TrialReport, Failed> {
    let mut decide = |observation: &[f32], goal: &[f32], action: &mut [f32]| {
        actor.act(observation, goal, action);
    };
    trials.run(number, &mut decide, witness).map_err(|error| failed(error, number))
}

/// A trial on its way into a log.
struct Recording {
    recorder: TrialRecorder,
    /// The first thing that could not be written.
    failure: Option<tandem_telemetry::Error>,
}

impl Witness for Recording {
    fn look(&mut self, look: &Look<'_>) {
        if self.failure.is_some() {
            return;
        }
        let joints = |angles: &Joints| angles.iter().copied().collect::<Vec<f64>>();
        let planned: Option<Vec<Vec<f64>>> =
            look.planned.map(|planned| planned.iter().map(joints).collect());
        let arms = look.measured.map(|state| state.arms.as_slice()).unwrap_or_default();
        let measured: Vec<Vec<f64>> = arms.iter().map(|arm| joints(&arm.angles)).collect();
        let openings: Vec<f64> = arms.iter().map(|arm| arm.opening).collect();
        let [planned_tools, measured_tools] =
            [&look.tools.planned, &look.tools.measured].map(|tools| places(tools));
        let written = self.recorder.look(&TrialLook {
            time_s: look.time_s,
            scene: &look.scene,
            planned_joints: planned.as_deref(),
            measured_joints: &measured,
            planned_tools: &planned_tools,
            measured_tools: &measured_tools,
            openings: &openings,
        });
        self.failure = written.err();
    }
}

impl Recording {
    fn finish(self, row: &TrialRow) -> Result<(), Failed> {
        if let Some(error) = self.failure {
            return Err(Failed::new(Exit::TryAgain, error));
        }
        let finished = self.recorder.finish(&TrialOutcome::from(row));
        finished.map(|_| ()).or_exit(Exit::TryAgain, String::new)
    }
}

fn places(tools: &[glam::DVec3]) -> Vec<[f64; 3]> {
    tools.iter().map(|tool| tool.to_array()).collect()
}

fn tools_at(point: &tandem_trials::trial::PathPoint) -> ToolsAt {
    ToolsAt {
        time_s: point.time_s,
        planned: places(&point.planned),
        measured: places(&point.measured),
    }
}

fn failed(error: TrialError, number: u64) -> Failed {
    let exit = match &error {
        TrialError::NoRoom { .. } => Exit::Usage,
        _ => Exit::Bug,
    };
    Failed::new(exit, anyhow::Error::new(error).context(format!("trial {number}")))
}

fn show(args: &TrialArgs, rows: Vec<TrialRow>, file: &Path) -> Result<(), Failed> {
    let trials = tandem_report::Trials::of(rows);
    let page = file.with_file_name("report.html");
    let nothing = Comparison::of(Vec::new(), Vec::new());
    let written =
        report_html(&nothing, &trials, Pictured::Failures, &page).or_cannot_write(String::new)?;
    if args.json {
        let mut value = json!({ "trials": tandem_report::trials::json(&trials) });
        value["file"] = json!(file);
        value["report"] = json!(written.page);
        output::print(value)?;
        return Ok(());
    }
    output::print(trials.text())?;
    output::print(format_args!("trials        {}", file.display()))?;
    output::print(format_args!(
        "report        {}, {} pictures beside it",
        page.display(),
        written.figures.len()
    ))?;
    Ok(())
}

/// The name of a policy's file, or of the run directory in which it lies.
fn name_of(path: &Path) -> String {
    let of_run = path.parent().filter(|directory| directory.ends_with("policy"));
    let named = of_run.and_then(Path::parent).and_then(Path::file_name);
    named.or(path.file_stem()).unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}
