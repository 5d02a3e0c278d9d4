//! What a run is to be, where it is kept and which processes it takes.

use std::path::{Path, PathBuf};

use tandem_learner::RunConfig;
use toml::Value;

use crate::cli::{RecipeName, TrainArgs};
use crate::exit::{Failed, OrExit as _};
use crate::{eval, files, run_file};

/// A run that can be started.
pub(crate) struct Plan {
    pub(crate) config: RunConfig,
    pub(crate) out: PathBuf,
    pub(crate) teacher: Option<PathBuf>,
    pub(crate) n_workers: usize,
    pub(crate) resume: bool,
}

impl Plan {
    /// Decides everything, and refuses what cannot be started.
    pub(crate) fn of(args: &TrainArgs) -> Result<Self, Failed> {
        let file = match (&args.run, &args.out) {
            (None, Some(out)) if args.resume => Some(out.join("run.toml")),
            (run, _) => run.clone(),
        };
        let mut config = run_file::resolve(file.as_deref(), &settings(args)?)?;
        let out = match &args.out {
            Some(out) => out.clone(),
            None => free_run_directory(&config),
        };
        if !args.resume {
            config.name = account_name(&out).unwrap_or(config.name);
        }
        let teacher = match config.advice.needs_teacher() {
            true => Some(teacher_path(args, &config, &out)?),
            false => None,
        };
        let n_workers = args.workers.unwrap_or_else(|| default_workers(&config));
        if !(1..=1024).contains(&n_workers) {
            return Err(Failed::usage(format!("--workers {n_workers}: expected 1 to 1024")));
        }
        Ok(Self { config, out, teacher, n_workers, resume: args.resume })
    }

    /// Creates the run directory with what the run is made of.
    pub(crate) fn prepare(&self) -> Result<(), Failed> {
        let out = &self.out;
        let holds_a_run = out.join("run.toml").exists();
        if holds_a_run && !self.resume {
            let shown = out.display();
            return Err(Failed::usage(format!(
                "{shown} holds a run already: go on with it by `tandem train --resume --out {shown}`, or choose another --out"
            )));
        }
        if self.resume && !holds_a_run {
            return Err(Failed::usage(format!("{} holds no run to go on with", out.display())));
        }
        let failed = || format!("cannot write to {}", out.display());
        std::fs::create_dir_all(out.join("policy")).or_cannot_write(failed)?;
        run_file::save(&self.config, &self.run_file())?;
        if let Some(teacher) = &self.teacher
            && *teacher != self.teacher_copy()
        {
            std::fs::copy(teacher, self.teacher_copy()).or_cannot_write(failed)?;
        }
        Ok(())
    }

    pub(crate) fn run_file(&self) -> PathBuf {
        self.out.join("run.toml")
    }

    pub(crate) fn log_path(&self) -> PathBuf {
        self.out.join("tandem.log")
    }

    pub(crate) fn best_policy(&self) -> PathBuf {
        self.out.join("policy/best.safetensors")
    }

    /// The teacher's policy, kept with the run.
    pub(crate) fn teacher_copy(&self) -> PathBuf {
        teacher_copy(&self.out)
    }
}

fn teacher_copy(out: &Path) -> PathBuf {
    out.join("policy/teacher.safetensors")
}

/// What the command line says, as settings of the run file; flags come after `--set`.
fn settings(args: &TrainArgs) -> Result<Vec<(String, Value)>, Failed> {
    let mut settings = args
        .settings
        .iter()
        .map(|setting| run_file::parse_setting(setting))
        .collect::<Result<Vec<_>, _>>()?;
    let whole =
        |n: u64| i64::try_from(n).map_or_else(|_| Value::String(n.to_string()), Value::Integer);
    let recipe = args.recipe.map(|recipe| match recipe {
        RecipeName::Tandem => "tandem",
        RecipeName::Paper => "paper",
    });
    let flags = [
        ("task", args.task.map(|task| Value::String(eval::task(task).name().to_owned()))),
        ("arms", args.arms.map(|n| whole(n as u64))),
        ("recipe", recipe.map(|name| Value::String(name.to_owned()))),
        ("advice.strategy", args.strategy.clone().map(Value::String)),
        ("advice.budget", args.budget.map(whole)),
        ("seed", args.seed.map(whole)),
        ("stop.until_success", args.until_success.map(Value::Float)),
        ("stop.max_env_steps", args.max_env_steps.map(whole)),
        ("stop.max_minutes", args.max_minutes.map(Value::Float)),
    ];
    settings.extend(flags.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?))));
    Ok(settings)
}

/// One worker a core, but no more than there are slots.
fn default_workers(config: &RunConfig) -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get).min(config.rounds.slots)
}

/// The run directory's own name, where it can be the name of an account at a teacher.
fn account_name(out: &Path) -> Option<String> {
    let name = out.file_name()?.to_str()?;
    tandem_learner::config::is_name(name).then(|| name.to_owned())
}

/// `runs/TASK-ARMS-STRATEGY-seedN`, with a number behind it when that is taken.
fn free_run_directory(config: &RunConfig) -> PathBuf {
    let strategy = config.advice.strategy.replace(':', "-");
    let name = format!("{}-{}-{strategy}-seed{}", config.task, config.arms, config.seed);
    let base = Path::new("runs").join(name);
    let numbered = (2..).map(|n: u32| PathBuf::from(format!("{}.{n}", base.display())));
    std::iter::once(base.clone()).chain(numbered).find(|path| !path.exists()).unwrap_or(base)
}

/// The teacher's file, checked: it must be a one-arm policy for the task.
fn teacher_path(args: &TrainArgs, config: &RunConfig, out: &Path) -> Result<PathBuf, Failed> {
    let path = match &args.teacher {
        Some(path) => path.clone(),
        None if args.resume && teacher_copy(out).exists() => teacher_copy(out),
        None => shipped_teacher(&config.task)?,
    };
    let policy = files::load_policy(&path)?;
    let shown = path.display();
    if policy.layout.n_arms != 1 {
        return Err(Failed::usage(format!(
            "{shown} drives {} arms: a teacher drives one",
            policy.layout.n_arms
        )));
    }
    if policy.layout.task.name() != config.task {
        return Err(Failed::usage(format!(
            "{shown} is a teacher for {}, the run is for {}",
            policy.layout.task, config.task
        )));
    }
    Ok(path)
}

/// The teacher that ships: beside the caller, beside the program, or in the program's source tree.
pub(crate) fn shipped_teacher(task: &str) -> Result<PathBuf, Failed> {
    let name = format!("policies/teacher-{task}.safetensors");
    let beside_program =
        std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.join(&name)));
    let places = [
        Some(PathBuf::from(&name)),
        beside_program,
        Some(Path::new(env!("CARGO_MANIFEST_DIR")).join(&name)),
    ];
    places.into_iter().flatten().find(|path| path.exists()).ok_or_else(|| {
        Failed::usage(format!(
            "no teacher for {task} ships at {name}: train one with `tandem train --arms 1 --task {task}` and give its \
             policy/best.safetensors with --teacher"
        ))
    })
}
