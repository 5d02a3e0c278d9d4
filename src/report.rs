//! `tandem report`: compares runs and trials on the terminal, as an HTML page, as JSON, as CSV and as Markdown.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde_json::json;
use tandem_report::{
    Baseline, Comparison, FilmStrip, PlottedTrials, ReportFiles, ReportInputs, Run, TestEvaluation,
    Trials, export, report_html, trials,
};

use tandem_core::Task;
use tandem_core::evaluation::TEST_SEED;
use tandem_core::text::counted;
use tandem_system::atomic_file;
use tandem_telemetry::ContactMetrics;

use crate::cli::ReportArgs;
use crate::evaluation::{EvaluatedPolicy, EvaluationResult, measure};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{film, output, policy_file, run_file};

/// Number of test goals for the evaluation of composed teachers, as for `tandem eval` and at the end of a run.
const TEST_EPISODES: u64 = 240;

pub(crate) fn report(args: &ReportArgs) -> Result<(), Failed> {
    for file in [&args.csv, &args.markdown].into_iter().flatten() {
        output::check_directory_of(file)?;
    }
    let page = args.out.clone().unwrap_or_else(|| default_page(&args.paths));
    output::check_is_no_directory(&page)?;
    output::check_distinct(&[
        ("--out", Some(page.as_path())),
        ("--csv", args.csv.as_deref()),
        ("--markdown", args.markdown.as_deref()),
    ])?;
    let mut inputs = ReportInputs::load(&args.paths).or_exit(Exit::Data, String::new)?;
    for run in &mut inputs.runs {
        // Runs of one configuration form a group, whichever version wrote their files.
        let completed = run.configuration.as_deref().and_then(run_file::completed);
        run.configuration = completed.or(run.configuration.take());
    }
    let trials = Trials::of(inputs.trials);
    warn(inputs.warnings.iter().chain(&trials.warnings));
    let mut comparison = {
        let baselines = baselines(args, &inputs.runs)?;
        Comparison::of(inputs.runs, baselines)
    };
    comparison.films = films(args)?;
    let plotted = if args.all_trials { PlottedTrials::All } else { PlottedTrials::Failed };
    let files = report_html(&comparison, &trials, plotted, &page).or_cannot_write(String::new)?;
    write(args.csv.as_deref(), || export::csv(&comparison))?;
    write(args.markdown.as_deref(), || comparison.markdown())?;
    print(args, &comparison, &trials, &files)
}

/// Writes `text` to a file that the command line names.
fn write(path: Option<&Path>, text: impl FnOnce() -> String) -> Result<(), Failed> {
    path.map_or(Ok(()), |path| {
        let written = atomic_file::replace_target(path, text().as_bytes());
        written.or_cannot_write(|| format!("cannot write {}", path.display()))
    })
}

fn print(
    args: &ReportArgs,
    comparison: &Comparison,
    trials: &Trials,
    files: &ReportFiles,
) -> Result<(), Failed> {
    if args.json {
        let mut value = export::json(comparison);
        value["trials"] = trials::json(trials);
        value["report"] = json!(files.page.to_string_lossy());
        let figures = files.plots.iter().map(|path| path.to_string_lossy());
        value["figures"] = figures.collect();
        return output::print(value);
    }
    if !trials.groups.is_empty() {
        output::print(trials.text())?;
        output::print(
            "median time: over all trials, including failures; [95 % interval of the share]",
        )?;
    }
    if !comparison.sections.is_empty() {
        output::print(comparison.text())?;
        output::print(comparison.notes())?;
    }
    output::print(format_args!("report        {}", files.page.display()))?;
    if let Some(directory) = files.plots.first().and_then(|figure| figure.parent()) {
        let n_figures = counted(files.plots.len(), "file");
        output::print(format_args!("figures       {}: {n_figures}", directory.display()))?;
    }
    for (label, path) in [("csv", &args.csv), ("markdown", &args.markdown)] {
        if let Some(path) = path {
            output::print(format_args!("{label:<13} {}", path.display()))?;
        }
    }
    Ok(())
}

fn warn<'a>(warnings: impl Iterator<Item = &'a String>) {
    for warning in warnings {
        output::message(format_args!("tandem: warning: {warning}"));
    }
}

/// Returns the results of policies that no run of the report has trained.
fn baselines(args: &ReportArgs, runs: &[Run]) -> Result<Vec<Baseline>, Failed> {
    let mut baselines = Vec::new();
    for path in &args.evals {
        let test = TestEvaluation::load(path).or_exit(Exit::Data, String::new)?;
        baselines.push(Baseline { label: stem(path), test });
    }
    for path in &args.composed_teachers {
        let teacher = policy_file::load(path)?;
        for task in advised_tasks(runs, teacher.layout.name()) {
            let composed = EvaluatedPolicy::composed(teacher.clone(), (task, 2), path)?;
            let result = measure(&composed, (TEST_EPISODES, TEST_SEED), &mut |_| {})?;
            let label = format!("composed {}", stem(path));
            baselines.push(Baseline { label, test: test_evaluation(&composed, &result) });
        }
    }
    Ok(baselines)
}

/// Returns the built-in two-arm tasks of `runs` in which a teacher of `one_arm_task` advises; `None`, for that task itself,
/// if there are none.
fn advised_tasks(runs: &[Run], one_arm_task: &str) -> Vec<Option<Task>> {
    let tasks: BTreeSet<Task> = runs
        .iter()
        .filter_map(|run| run.task()?.parse().ok())
        .filter(|task: &Task| task.of_one_arm().name() == one_arm_task)
        .collect();
    if tasks.is_empty() { vec![None] } else { tasks.into_iter().map(Some).collect() }
}

fn test_evaluation(subject: &EvaluatedPolicy, result: &EvaluationResult) -> TestEvaluation {
    let (layout, summary) = (subject.layout(), &result.summary);
    TestEvaluation {
        task: layout.task.to_string(),
        n_arms: layout.n_arms,
        n_episodes: summary.n_episodes as u64,
        success: summary.success,
        interval: (summary.interval.low, summary.interval.high),
        success_joint: summary.success_joint,
        collision_rate: Some(summary.collision_rate),
        contacts: ContactMetrics::of(summary),
    }
}

/// Returns the name of a file without its ending, or of a run directory.
fn stem(path: &Path) -> String {
    let name = if path.is_dir() { path.file_name() } else { path.file_stem() };
    name.unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Plays the test goals with each policy of `--film-strips` and draws the first success and the first failure.
fn films(args: &ReportArgs) -> Result<Vec<FilmStrip>, Failed> {
    let mut films = Vec::new();
    for (path, n) in args.film_strips.iter().zip(1..) {
        let subject = EvaluatedPolicy::new(policy_file::load(path)?, path)?;
        let episodes = subject.play(0..TEST_EPISODES, TEST_SEED)?;
        for outcome in film::OUTCOMES {
            match film::of_outcome(subject.layout(), TEST_SEED, &episodes, outcome)? {
                Some(strip) => films.push(FilmStrip {
                    title: format!("{}: {}", path.display(), strip.title),
                    file_name: strip.file_name.replace("film-", &format!("film-{n}-")),
                    ..strip
                }),
                None => warn(std::iter::once(&format!(
                    "{}: no {} on {TEST_EPISODES} test goals",
                    path.display(),
                    outcome.0
                ))),
            }
        }
    }
    Ok(films)
}

/// Returns `report.html` in the directory of the report if there is a single one, else in the working directory. The
/// directory of a run has a page of that name, so that the comparison becomes `comparison.html`.
fn default_page(paths: &[PathBuf]) -> PathBuf {
    match paths {
        [dir] if dir.join("metrics.jsonl").exists() => dir.join("comparison.html"),
        [dir] if dir.is_dir() => dir.join("report.html"),
        _ if Path::new("metrics.jsonl").exists() => PathBuf::from("comparison.html"),
        _ => PathBuf::from("report.html"),
    }
}
