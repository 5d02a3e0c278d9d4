//! `tandem bridge trial`: runs policies on the simulated pair.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use clap::ValueEnum as _;
use indicatif::ProgressBar;
use serde_json::json;
use tandem_core::text::counted;
use tandem_core::{Layout, Task};
use tandem_policy::policy::RANDOMIZATION_KEY;
use tandem_report::{Comparison, PlottedTrials, report_html};
use tandem_system::DirectoryLock;
use tandem_telemetry::trials::TRIALS_FILE;
use tandem_telemetry::{TrialRow, TrialsLog};
use tandem_trials::simulated::{Block, GripperConfig};
use tandem_trials::trial::mapping::TRAINED_HALF_M;
use tandem_trials::trial::{TrialConfig, TrialError, TrialMode, TrialReport};
use tandem_trials::{NamedPolicy, Series, SeriesError, SimulatedConfig};

use crate::bridge::file;
use crate::cli::{ModeName, RecordName, TaskName, TrialArgs, check_task};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, policy_file, run_directory};

/// Density of the blocks, kilograms per cubic metre: a block of 5.6 cm has 0.12 kg.
const DENSITY_KGPM3: f32 = 683.3;
/// Lightest and heaviest block, kilograms.
const MASS_KG: [f32; 2] = [0.05, 0.25];
/// Smallest and largest block, centimetres, as in the training world.
const BLOCK_CM: [f32; 2] = [3.0, 9.0];
const DEFAULT_BLOCK_CM: f32 = 5.6;
/// Longest trial, seconds.
const TIME_LIMIT_S: f64 = 120.0;

/// Directories of the trials' motions and logs.
const MOTIONS: &str = "motions";
const LOGS: &str = "mcap";

pub(crate) fn trial(args: &TrialArgs) -> Result<(), Failed> {
    let (task, policies) = policies(args)?;
    let block = block(args.block_cm, task)?;
    if !(0.01..=1.0).contains(&args.speed) {
        return Err(Failed::usage(format!("--speed {}: expected 0.01 to 1", args.speed)));
    }
    if !(0.0..=2.0).contains(&args.pad_friction) {
        let message = format!("--pad-friction {}: expected 0 to 2", args.pad_friction);
        return Err(Failed::usage(message));
    }
    let gripper = GripperConfig { pad_friction: args.pad_friction, ..GripperConfig::default() };
    let all_modes = [ModeName::ClosedLoop, ModeName::Twin, ModeName::OpenLoop];
    let modes = if args.modes.is_empty() { &all_modes[..] } else { &args.modes };
    if let Some(mode) =
        modes.iter().enumerate().find_map(|(idx, mode)| modes[..idx].contains(mode).then_some(mode))
    {
        let name =
            mode.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned());
        return Err(Failed::usage(format!("--mode {name} is given twice")));
    }
    let (out, _lock) = locked_directory(args.out.as_deref(), task)?;
    if args.motions {
        create_directory(&out.join(MOTIONS))?;
    }
    let file = out.join(TRIALS_FILE);
    let mut log = TrialsLog::create(&file).or_cannot_write(String::new)?;
    let mut all = Vec::new();
    for policy in &policies {
        for mode in modes {
            let config = TrialConfig {
                layout: Layout::new(task, 2),
                mode: mode_of(*mode),
                block,
                trained_half_m: trained_half_m(policy, task, &block),
                n_rehearsals: args.rehearsals,
                seed: args.seed,
                speed: args.speed,
                simulated: SimulatedConfig { gripper, ..SimulatedConfig::default() },
                time_limit_s: TIME_LIMIT_S,
            };
            let series = Series { policy, config };
            let rows = run(&series, args, &out, &mut log).map_err(|(failed, n_rows)| {
                match all.len() as u64 + n_rows {
                    0 => failed,
                    n_rows => {
                        failed.context(format!("{} has the first {n_rows} trials", file.display()))
                    }
                }
            })?;
            all.extend(rows);
        }
    }
    show(args, all, &file)
}

/// Creates and locks the directory `out`. Without one it is `runs/trial-TASK`, with a number appended if that has trials or
/// if another process writes to it.
fn locked_directory(out: Option<&Path>, task: Task) -> Result<(PathBuf, DirectoryLock), Failed> {
    let has_trials =
        |out: &Path| std::fs::metadata(out.join(TRIALS_FILE)).is_ok_and(|file| file.len() > 0);
    if let Some(out) = out {
        create_directory(out)?;
        return Ok((out.to_owned(), run_directory::lock_for("--out", out)?));
    }
    let base = format!("runs/trial-{task}");
    let mut out = PathBuf::from(&base);
    for n in 2_u64.. {
        create_directory(&out)?;
        if let Some(lock) = run_directory::lock(&out)?
            && !has_trials(&out)
        {
            return Ok((out, lock));
        }
        out = format!("{base}.{n}").into();
    }
    unreachable!("a number is free")
}

/// Returns half the edge of the blocks that `policy` was trained with, metres. Where sizes varied it knows those of `block`;
/// an object that the arms share keeps its size.
fn trained_half_m(policy: &NamedPolicy, task: Task, block: &Block) -> f64 {
    let is_varied = !task.shares_object() && policy.policy.metadata.contains_key(RANDOMIZATION_KEY);
    if is_varied { f64::from(block.half_m) } else { TRAINED_HALF_M }
}

const fn mode_of(name: ModeName) -> TrialMode {
    match name {
        ModeName::ClosedLoop => TrialMode::ClosedLoop,
        ModeName::OpenLoop => TrialMode::OpenLoop,
        ModeName::Twin => TrialMode::Twin,
    }
}

/// Loads the policies and determines their common task.
fn policies(args: &TrialArgs) -> Result<(Task, Vec<NamedPolicy>), Failed> {
    let mut policies = Vec::new();
    for path in &args.policies {
        let file = policy_file::file_of(path)?;
        let policy = policy_file::load(&file)?;
        if policy.task.n_arms() != 2 {
            return Err(Failed::usage(format!(
                "{} drives {}, the bridge has 2: a one-arm policy goes with --composed-teachers",
                path.display(),
                counted(policy.task.n_arms(), "arm")
            )));
        }
        policies.push(NamedPolicy { name: name_of(&file), policy });
    }
    for path in &args.composed_teachers {
        let file = policy_file::file_of(path)?;
        let policy = policy_file::load(&file)?;
        if policy.task.n_arms() != 1 {
            return Err(Failed::usage(format!(
                "{} drives {} arms: a teacher drives one",
                path.display(),
                policy.task.n_arms()
            )));
        }
        policies.push(NamedPolicy { name: format!("composed-{}", name_of(&file)), policy });
    }
    let mut names = BTreeSet::new();
    if let Some(again) = policies.iter().find(|named| !names.insert(&named.name)) {
        return Err(Failed::usage(format!(
            "two policies are called {:?}, after their files or run directories: copy one to a file of another name",
            again.name
        )));
    }
    let own_task = |named: &NamedPolicy| {
        let built_in = named.policy.task.as_built_in().map(|layout| layout.task);
        built_in.ok_or_else(|| {
            let (name, task) = (&named.name, named.policy.task.name());
            Failed::usage(format!("{name} is for {task}, which simulated arms cannot perform"))
        })
    };
    let Some(first) = policies.first() else {
        return Err(Failed::usage("give --policy or --composed-teachers"));
    };
    let task = task_of(first, own_task(first)?, args.task.map(TaskName::in_default_world));
    check_task(task, args.task, args.world)?;
    for named in &policies {
        let own = own_task(named)?;
        if task_of(named, own, Some(task)) != task {
            let message = format!("{} is for {own}, not {task}", named.name);
            return Err(Failed::usage(message));
        }
    }
    Ok((task, policies))
}

/// Returns the task in which a policy whose own task is `own` is tried: `wanted` if it performs the part of one arm of that,
/// otherwise its own.
fn task_of(named: &NamedPolicy, own: Task, wanted: Option<Task>) -> Task {
    let is_composed = named.policy.task.n_arms() == 1;
    wanted.filter(|wanted| is_composed && wanted.of_one_arm() == own).unwrap_or(own)
}

/// Returns the blocks of `task` with edges of `edge_cm` centimetres. An object that the arms share has no such edge.
fn block(edge_cm: Option<f32>, task: Task) -> Result<Block, Failed> {
    if edge_cm.is_some() && task.shares_object() {
        let message =
            format!("--block-cm: both arms of {task} share an object, which keeps its size");
        return Err(Failed::usage(message));
    }
    let edge_cm = edge_cm.unwrap_or(DEFAULT_BLOCK_CM);
    let [low, high] = BLOCK_CM;
    if !(low..=high).contains(&edge_cm) {
        return Err(Failed::usage(format!("--block-cm {edge_cm}: expected {low} to {high}")));
    }
    let half_m = 0.005 * edge_cm;
    let mass_kg = DENSITY_KGPM3 * (2.0 * half_m).powi(3);
    let mass_kg = mass_kg.clamp(MASS_KG[0], MASS_KG[1]);
    Ok(Block { half_m, mass_kg, ..Block::small([0.0; 2]) })
}

/// Writes rows in the order of their numbers, each as soon as those before it are written.
struct OrderedRows<'a> {
    log: &'a mut TrialsLog,
    n_written: u64,
    waiting: BTreeMap<u64, TrialRow>,
}

impl OrderedRows<'_> {
    fn add(&mut self, row: TrialRow) -> Result<(), Failed> {
        self.waiting.insert(row.trial, row);
        while let Some(row) = self.waiting.remove(&self.n_written) {
            self.log.append(&row).map_err(Failed::of_write)?;
            self.n_written += 1;
        }
        Ok(())
    }
}

/// Runs the trials of `series` with a progress bar, writes their rows to `log`, and their motions and logs if `args` ask for
/// them. An error comes with the number of rows that are written.
fn run(
    series: &Series<'_>,
    args: &TrialArgs,
    out: &Path,
    log: &mut TrialsLog,
) -> Result<Vec<TrialRow>, (Failed, u64)> {
    let label = format!("{}, {}", series.policy.name, series.config.mode.name());
    let bar = ProgressBar::new(args.trials).with_prefix(label);
    let style = indicatif::ProgressStyle::with_template("{prefix} {wide_bar} {pos} of {len}");
    let style = style.or_exit(Exit::Bug, String::new).map_err(|failed| (failed, 0))?;
    let bar = bar.with_style(style);
    let written = Mutex::new(OrderedRows { log, n_written: 0, waiting: BTreeMap::new() });
    let rows = series.run(args.trials, |report, row| {
        let name = format!("{}-{}-{:04}", row.policy, row.mode, row.trial);
        if args.motions {
            let path = out.join(MOTIONS).join(format!("{name}.json"));
            match file::refusal(report.waypoints.len()) {
                Some(refusal) => bar.suspend(|| {
                    output::message(format_args!(
                        "trial {}: no {}: {refusal}",
                        row.trial,
                        path.display()
                    ));
                }),
                None => write_motion(report, series.config.speed, &path).map_err(SeriesFailed)?,
            }
        }
        let recorded = match args.record {
            RecordName::All => true,
            RecordName::Failures => !row.success,
            RecordName::None => false,
        };
        if recorded {
            let log = row.log.insert(format!("{LOGS}/{name}.mcap")).clone();
            create_directory(&out.join(LOGS)).map_err(SeriesFailed)?;
            series.record(row, &out.join(log))?;
        }
        let mut written = written.lock().unwrap_or_else(PoisonError::into_inner);
        written.add(row.clone()).map_err(SeriesFailed)?;
        bar.inc(1);
        Ok(())
    });
    bar.finish_and_clear();
    let n_written = written.into_inner().unwrap_or_else(PoisonError::into_inner).n_written;
    rows.map_err(|SeriesFailed(failed)| (failed, n_written))
}

fn write_motion(report: &TrialReport, speed: f64, path: &Path) -> Result<(), Failed> {
    if report.waypoints.is_empty() {
        return Ok(());
    }
    file::write(path, speed, &report.waypoints)
}

fn create_directory(path: &Path) -> Result<(), Failed> {
    std::fs::create_dir_all(path).or_cannot_write(|| format!("cannot create {}", path.display()))
}

/// A failure of the trials or of their files.
struct SeriesFailed(Failed);

impl From<SeriesError> for SeriesFailed {
    fn from(error: SeriesError) -> Self {
        let exit = match &error {
            SeriesError::Log(_) => return Self(Failed::of_write(error)),
            SeriesError::Policy(_) => Exit::Data,
            SeriesError::Trial { source: TrialError::NoRoom { .. }, .. } => Exit::Usage,
            _ => Exit::Bug,
        };
        Self(Failed::new(exit, error))
    }
}

fn show(args: &TrialArgs, rows: Vec<TrialRow>, file: &Path) -> Result<(), Failed> {
    let trials = tandem_report::Trials::of(rows);
    let page = file.with_file_name("report.html");
    let nothing = Comparison::of(Vec::new(), Vec::new());
    let written = report_html(&nothing, &trials, PlottedTrials::Failed, &page)
        .or_cannot_write(String::new)?;
    if args.json {
        let mut value = json!({ "trials": tandem_report::trials::json(&trials) });
        value["file"] = json!(file.to_string_lossy());
        value["report"] = json!(written.page.to_string_lossy());
        output::print(value)?;
        return Ok(());
    }
    output::print(trials.text())?;
    output::print(format_args!("trials        {}", file.display()))?;
    output::print(format_args!("report        {}", page.display()))?;
    if !written.plots.is_empty() {
        let figures = counted(written.plots.len(), "figure");
        output::print(format_args!("figures       {figures} of the report as files"))?;
    }
    Ok(())
}

/// Returns the name of a policy's file, or of the run directory that contains it.
fn name_of(path: &Path) -> String {
    let of_run = path.parent().filter(|directory| directory.ends_with("policy"));
    let named = of_run.and_then(Path::parent).and_then(Path::file_name);
    named.or(path.file_stem()).unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}
