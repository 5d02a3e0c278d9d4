//! The plan of a run: its settings, its directory, its teacher and the number of workers.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use tandem_learner::{checkpoint, settings};
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;
use tandem_worker::ServedTask;
use toml::Value;

use super::teacher_file::{TeacherFile, path_of_new_run};
use crate::cli::{EnvironmentArgs, RecipeName, RecordingArgs, TrainArgs, chosen_task};
use crate::columns::wrapped;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::run_directory::RUNS;
use crate::service::worker_failed;
use crate::shell::shell_word;
use crate::{
    dashboard, environment_file, output, policy_file, run_directory, run_file, served_task,
};

/// A run that can be started.
pub(crate) struct Plan {
    pub(crate) config: RunConfig,
    pub(crate) out: PathBuf,
    pub(crate) teacher: Option<TeacherFile>,
    pub(crate) n_workers: usize,
    pub(crate) resume: bool,
    /// The server of the environments, if workers do not simulate them.
    pub(crate) environment: EnvironmentArgs,
    /// The episodes that workers record.
    pub(crate) recording: RecordingArgs,
    /// The first address that the dashboard tries, unless there is none.
    pub(crate) dashboard: Option<SocketAddr>,
    /// File with the token of the dashboard.
    pub(crate) dashboard_token_file: Option<PathBuf>,
    /// The address of the learner's metrics, if they are served.
    pub(crate) metrics: Option<SocketAddr>,
}

impl Plan {
    /// Resolves the command line, and rejects a run that cannot be started. `served` is the task of the server that
    /// `environment` names, if it names one.
    pub(crate) fn of(
        args: &TrainArgs,
        environment: EnvironmentArgs,
        served: Option<&ServedTask>,
    ) -> Result<Self, Failed> {
        let (config, directory) = named_config(args, served)?;
        if directory.is_numbered() && !args.quiet {
            remark_on(&directory);
        }
        let out = directory.path;
        let teacher = match config.advice.needs_teacher() {
            true => Some(teacher_file(args, &config, &out)?),
            false => None,
        };
        check_advice_options(args, &config)?;
        let n_workers = args.workers.unwrap_or_else(|| default_workers(&config));
        if !(1..=1024).contains(&n_workers) {
            return Err(Failed::usage(format!("--workers {n_workers}: expected 1 to 1024")));
        }
        let (resume, recording) = (args.resume, args.recording);
        let dashboard = dashboard::address(&args.dashboard)?;
        let dashboard_token_file = args.dashboard.dashboard_token_file.clone();
        let plan = Self {
            config,
            out,
            teacher,
            n_workers,
            resume,
            environment,
            recording,
            dashboard,
            dashboard_token_file,
            metrics: args.metrics.metrics_listen,
        };
        plan.check_directory()?;
        Ok(plan)
    }

    /// Rejects a new run in a directory that contains a run, and a resume in one that does not.
    fn check_directory(&self) -> Result<(), Failed> {
        let (shown, word) = (self.out.display(), shell_word(&self.out));
        match (self.run_file().exists(), self.resume) {
            (true, false) => Err(Failed::usage(format!(
                "{shown} holds a run already: resume it with `tandem train --resume --out {word}`, or choose another --out"
            ))),
            (false, true) => Err(run_directory::no_run(&format!("{shown} holds no run to resume"))),
            (false, false) => match run_directory::runs_in(&self.out).first() {
                Some(run) => Err(Failed::usage(format!(
                    "{shown} holds other runs, such as {}: choose another --out",
                    run.display()
                ))),
                None => Ok(()),
            },
            (true, true) => Ok(()),
        }
    }

    /// Checks the plan against the run directory, and writes the files of a new run. The directory of a resumed run is
    /// not changed: its learner writes changed settings once the run continues.
    pub(crate) fn prepare(&self) -> Result<(), Failed> {
        self.check_directory()?;
        if self.resume {
            self.check_settings()?;
            return self.check_teacher();
        }
        let failed = || format!("cannot write to {}", self.out.display());
        std::fs::create_dir_all(self.out.join("policy")).or_cannot_write(failed)?;
        // The run file comes last: a directory with a run file can be resumed.
        self.keep_teacher()?;
        self.keep_environment()?;
        run_file::save(&self.config, &self.run_file())
    }

    /// Rejects settings that differ from those of the newest checkpoint or, without one, from those of the run file.
    fn check_settings(&self) -> Result<(), Failed> {
        let is_checked = checkpoint::check_settings(&self.checkpoints(), &self.config);
        if is_checked.or_exit(Exit::Usage, String::new)? {
            return Ok(());
        }
        let Ok(original) = run_file::resolve(Some(&self.run_file()), &[]) else { return Ok(()) };
        let original = settings::to_json(&original);
        match settings::first_change(&self.config, &original).or_exit(Exit::Bug, String::new)? {
            Some(changed) => {
                let path = self.run_file();
                Err(Failed::usage(format!("{changed}'s run file {path:?}: {}", settings::ADVICE)))
            }
            None => Ok(()),
        }
    }

    /// Rejects a teacher other than the run's own.
    fn check_teacher(&self) -> Result<(), Failed> {
        let Some(teacher) = &self.teacher else { return Ok(()) };
        let own = self.foreign_teacher().and_then(|_| TeacherFile::stored_in(&self.policies()));
        match own.filter(|own| own.digest != teacher.digest()) {
            Some(own) => Err(Failed::usage(format!(
                "--teacher {}: the run's own teacher, {}, is another policy: leave --teacher out, or start a new run",
                teacher.path().display(),
                own.path.display()
            ))),
            // A missing or damaged copy is replaced by the same policy.
            None => teacher.check_recorded(&self.policies()),
        }
    }

    /// Copies the teacher's files to the run directory, unless an intact copy exists.
    pub(crate) fn keep_teacher(&self) -> Result<(), Failed> {
        let Some(teacher) = self.foreign_teacher() else { return Ok(()) };
        if TeacherFile::stored_in(&self.policies()).is_some_and(|own| teacher.is_stored(&own)) {
            return Ok(());
        }
        let directory = self.policies();
        std::fs::create_dir_all(&directory)
            .or_cannot_write(|| format!("cannot write {}", directory.display()))?;
        teacher.copy_to(&directory)?;
        teacher.record_digest(&directory)
    }

    /// Writes the server of the environments to the run directory, unless it is stored there.
    pub(crate) fn keep_environment(&self) -> Result<(), Failed> {
        environment_file::keep(&self.environment, &self.out)
    }

    /// Returns the teacher, unless it is the run's own copy.
    fn foreign_teacher(&self) -> Option<&TeacherFile> {
        let is_foreign =
            |teacher: &&TeacherFile| teacher.path() != teacher.copy_path(&self.policies());
        self.teacher.as_ref().filter(is_foreign)
    }

    /// Returns the directory of the run's policies.
    fn policies(&self) -> PathBuf {
        self.out.join("policy")
    }

    pub(crate) fn run_file(&self) -> PathBuf {
        self.out.join("run.toml")
    }

    pub(crate) fn log_path(&self) -> PathBuf {
        self.out.join("tandem.log")
    }

    pub(crate) fn best_policy(&self) -> PathBuf {
        self.out.join(policy_file::BEST)
    }

    /// Returns the directory of the checkpoints.
    pub(crate) fn checkpoints(&self) -> PathBuf {
        run_directory::checkpoints(&self.out)
    }

    /// Returns the directory of the logs of episodes.
    pub(crate) fn logs(&self) -> PathBuf {
        self.out.join("mcap")
    }

    /// Returns the path of the teacher's ledger.
    pub(crate) fn ledger(&self) -> PathBuf {
        run_directory::ledger(&self.out)
    }
}

/// Prints the run file of the run that the command line describes: all its settings. `served` is as in [`Plan::of`].
pub(super) fn print_run_file(args: &TrainArgs, served: Option<&ServedTask>) -> Result<(), Failed> {
    let (config, _) = named_config(args, served)?;
    check_advice_options(args, &config)?;
    output::print(run_file::to_text(&config)?.trim_end())
}

/// Resolves the settings, among them the run's name, and the run directory.
fn named_config(
    args: &TrainArgs,
    served: Option<&ServedTask>,
) -> Result<(RunConfig, NewDirectory), Failed> {
    let config = config(args, served)?;
    check_environment(&config, served)?;
    let directory = match &args.out {
        Some(out) => NewDirectory { path: out.clone(), usual: out.clone() },
        None => NewDirectory::free(&config),
    };
    let name = account_name(&directory.path).filter(|_| !args.resume);
    let config = RunConfig { name: name.unwrap_or_else(|| config.name.clone()), ..config };
    Ok((config, directory))
}

/// Rejects a task that neither the server nor the simulator has, and a server with too few environments for a slot.
fn check_environment(config: &RunConfig, served: Option<&ServedTask>) -> Result<(), Failed> {
    let task = config.task_spec().or_exit(Exit::Usage, String::new)?;
    match served {
        Some(served) => {
            served.check(&task).map_err(worker_failed)?;
            served.check_room(config.largest_slot()).map_err(worker_failed)
        }
        None if task.as_built_in().is_none() => Err(Failed::usage(format!(
            "task {:?} is not built-in: name the server of its environments with --env or --env-command",
            task.name()
        ))),
        None => Ok(()),
    }
}

/// Resolves the settings; those of a resumed run come from its own run file.
fn config(args: &TrainArgs, served: Option<&ServedTask>) -> Result<RunConfig, Failed> {
    if args.resume && args.out.is_none() {
        return Err(run_directory::no_run("--resume needs --out DIR, the directory of the run"));
    }
    let own_file = args.out.as_ref().filter(|_| args.resume).map(|out| out.join("run.toml"));
    if let Some((file, out)) = own_file.as_ref().zip(args.out.as_ref())
        && !file.exists()
    {
        run_directory::check_path(out)?;
        return Err(run_directory::no_run(&format!("{} holds no run to resume", out.display())));
    }
    let settings = [served_settings(args, served)?, settings_of(args)?].concat();
    if let Some(own_file) = own_file.as_ref().filter(|_| args.run.is_none()) {
        check_task(own_file, &settings)?;
    }
    let mut config = run_file::resolve(args.run.as_deref().or(own_file.as_deref()), &settings)?;
    let is_named = settings.iter().any(|(key, _)| key == "name");
    // A resumed run keeps its name and its interval between evaluations, even if --run names another run file.
    if let Some(own_file) = own_file.filter(|_| args.run.is_some())
        && let Ok(existing) = run_file::resolve(Some(&own_file), &[])
    {
        run_file::keep_interval(&mut config, &existing);
        if !is_named {
            config.name = existing.name;
        }
    }
    Ok(config)
}

/// Rejects a resume for another task, number of arms or recipe, on which the values of other settings depend.
fn check_task(own_file: &Path, settings: &[(String, Value)]) -> Result<(), Failed> {
    let Ok(run) = run_file::resolve(Some(own_file), &[]) else { return Ok(()) };
    let of_run = [
        ("task", run.task.clone()),
        ("arms", run.arms.to_string()),
        ("recipe", run.recipe.to_string()),
    ];
    for (key, of_run) in of_run {
        let given = settings.iter().rev().find(|(name, _)| name == key).map(|(_, value)| value);
        let given =
            given.map(|value| value.as_str().map_or_else(|| value.to_string(), str::to_owned));
        if let Some(given) = given.filter(|given| *given != of_run) {
            return Err(Failed::usage(format!(
                "{key} is {given} here and {of_run} in the run file {own_file:?}: {}",
                settings::ADVICE
            )));
        }
    }
    Ok(())
}

/// Returns the settings that describe the task of a server, unless the task is built-in or the command line names a task
/// or a run.
fn served_settings(
    args: &TrainArgs,
    served: Option<&ServedTask>,
) -> Result<Vec<(String, Value)>, Failed> {
    let names_task =
        args.task.is_some() || args.world.is_some() || args.run.is_some() || args.resume;
    match served.filter(|_| !names_task) {
        Some(served) => served_task::settings(&served.task),
        None => Ok(Vec::new()),
    }
}

/// Converts the flags to settings of the run file, after those of `--set`.
fn settings_of(args: &TrainArgs) -> Result<Vec<(String, Value)>, Failed> {
    let mut settings = args
        .settings
        .iter()
        .map(|setting| run_file::parse_setting(setting))
        .collect::<Result<Vec<_>, _>>()?;
    let task = chosen_task(args.task, args.world)?;
    let names_task = args.run.is_some() || settings.iter().any(|(key, _)| key == "task");
    if args.world.is_some() && args.task.is_none() && (names_task || args.resume) {
        return Err(Failed::usage(
            "--world needs --task here: the task of a run file, --set or --resume includes its world",
        ));
    }
    let integer =
        |n: u64| i64::try_from(n).map_or_else(|_| Value::String(n.to_string()), Value::Integer);
    let recipe = args.recipe.map(|recipe| match recipe {
        RecipeName::Tandem => Recipe::Tandem,
        RecipeName::Paper => Recipe::Paper,
    });
    let flags = [
        ("task", task.map(|task| Value::String(task.name().to_owned()))),
        ("arms", args.arms.map(|n| integer(n as u64))),
        ("recipe", recipe.map(|recipe| Value::String(recipe.to_string()))),
        ("advice.strategy", args.strategy.clone().map(Value::String)),
        ("advice.budget", args.budget.map(integer)),
        ("seed", args.seed.map(integer)),
        ("stop.until_success", args.until_success.map(Value::Float)),
        ("stop.max_env_steps", args.max_env_steps.map(integer)),
        ("stop.max_minutes", args.max_minutes.map(Value::Float)),
    ];
    settings.extend(flags.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?))));
    Ok(settings)
}

/// Returns one worker per core, at most one per slot.
fn default_workers(config: &RunConfig) -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get).min(config.rounds.slots)
}

/// Returns the name of the run directory, if it is a valid name of a teacher's account.
fn account_name(out: &Path) -> Option<String> {
    let name = out.file_name()?.to_str()?;
    tandem_rl::config::is_name(name).then(|| name.to_owned())
}

/// The directory of a run.
struct NewDirectory {
    path: PathBuf,
    /// The path that it has unless that exists.
    usual: PathBuf,
}

impl NewDirectory {
    /// Returns `runs/TASK-ARMS-STRATEGY-seedN`, with a number appended if that exists.
    fn free(config: &RunConfig) -> Self {
        let strategy = config.advice.strategy.replace(':', "-");
        let task = config.task.replace('/', "-");
        let name = format!("{task}-{}-{strategy}-seed{}", config.arms, config.seed);
        let usual = Path::new(RUNS).join(name);
        let numbered = (2..).map(|n: u32| PathBuf::from(format!("{}.{n}", usual.display())));
        let free = std::iter::once(usual.clone()).chain(numbered).find(|path| !path.exists());
        Self { path: free.unwrap_or_else(|| usual.clone()), usual }
    }

    fn is_numbered(&self) -> bool {
        self.path != self.usual
    }
}

/// Reports that the run has another directory than usual, because there is a run in that one.
fn remark_on(NewDirectory { path, usual }: &NewDirectory) {
    let what = match usual.join("run.toml").exists() {
        true => {
            let (state, word) = (run_directory::state(usual), shell_word(usual));
            format!("{state}; `tandem train --resume --out {word}` resumes it")
        }
        false => "it holds no run".to_owned(),
    };
    let text = format!("{} exists ({what}): this run is {}", usual.display(), path.display());
    output::message(wrapped(&text, "  "));
}

/// Rejects options about advice for a run without any.
fn check_advice_options(args: &TrainArgs, config: &RunConfig) -> Result<(), Failed> {
    let options = [
        ("--teacher", args.teacher.is_some() && !config.advice.needs_teacher()),
        ("--teacher-critic", args.teacher_critic.is_some() && !config.advice.asks()),
        ("--budget", args.budget.is_some() && !config.advice.asks()),
    ];
    options.into_iter().find(|(_, is_useless)| *is_useless).map_or(Ok(()), |(option, _)| {
        let strategy = &config.advice.strategy;
        Err(Failed::usage(format!(
            "{option}: a run with strategy {strategy} does not use it: leave it out, or choose another --strategy"
        )))
    })
}

/// Loads the teacher, which must be a one-arm policy for the task.
fn teacher_file(args: &TrainArgs, config: &RunConfig, out: &Path) -> Result<TeacherFile, Failed> {
    let own = || TeacherFile::copy_in(&out.join("policy"));
    let own = (args.resume && args.teacher.is_none()).then(own).flatten();
    let teacher = match own {
        Some(own) => own?,
        None => {
            let path = path_of_new_run(args.teacher.as_deref(), config)?;
            TeacherFile::load(path, args.teacher_critic.clone())?
        }
    };
    teacher.check(config)?;
    if let Some(remark) = teacher.other_recipe(config).filter(|_| !args.resume) {
        output::message(format_args!("tandem: {remark}"));
    }
    Ok(teacher)
}
