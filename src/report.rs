//! `tandem report`: compares runs and trials on the terminal, as an HTML page, as JSON, as CSV and as Markdown.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde_json::json;
use tandem_report::{
    Baseline, Comparison, Configuration, FilmStrip, PlottedTrials, ReportFiles, ReportInputs, Run,
    TestEvaluation, Trials, export, report_html, trials,
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
    let page = args.out.clone().unwrap_or_else(|| default_page(&args.paths));
    check_outputs(args, &page)?;
    let mut inputs = ReportInputs::load(&args.paths).or_exit(Exit::Data, String::new)?;
    check_no_input(&outputs(args, &page), &inputs)?;
    for run in &mut inputs.runs {
        // Runs of one configuration form a group, whichever version wrote their files.
        let text = run.configuration.as_ref().map(Configuration::text);
        let completed = text.and_then(run_file::completed).and_then(|text| text.parse().ok());
        run.configuration = completed.or(run.configuration.take());
    }
    let trials = Trials::of(inputs.trials);
    warn(inputs.warnings.iter().chain(&trials.warnings));
    let mut comparison = {
        let baselines = baselines(args, &inputs.runs)?;
        Comparison::of(inputs.runs, baselines)
    };
    warn(comparison.warnings.iter());
    comparison.films = films(args)?;
    let plotted = if args.all_trials { PlottedTrials::All } else { PlottedTrials::Failed };
    let (written, failures) = Written::of(args, &comparison, (&trials, plotted), &page);
    // Also if a file could not be written, as in a directory that cannot be changed.
    let printed = print(args, &comparison, &trials, &written);
    let mut failures = printed.err().into_iter().chain(failures);
    let first = failures.next();
    failures.for_each(|failed| output::message(format_args!("tandem: {}", failed.line())));
    first.map_or(Ok(()), Err)
}

/// The files that a report has written.
#[derive(Default)]
struct Written<'a> {
    page: Option<ReportFiles>,
    /// Files with tables, each after its format.
    tables: Vec<(&'static str, &'a Path)>,
}

impl<'a> Written<'a> {
    /// Writes each file that the command line names, whether or not the others can be written, and returns the failures
    /// as well.
    fn of(
        args: &'a ReportArgs,
        comparison: &Comparison,
        (trials, plotted): (&Trials, PlottedTrials),
        page: &Path,
    ) -> (Self, Vec<Failed>) {
        let (mut written, mut failures) = (Self::default(), Vec::new());
        let files = report_html(comparison, trials, plotted, page)
            .or_cannot_write(|| "the page is not written, choose another --out".to_owned());
        match files {
            Ok(files) => written.page = Some(files),
            Err(failed) => failures.push(failed),
        }
        let tables: [(_, _, &dyn Fn() -> String); 2] = [
            ("csv", &args.csv, &|| export::csv(comparison)),
            ("markdown", &args.markdown, &|| comparison.markdown()),
        ];
        for (format, path, text) in tables {
            let Some(path) = path else { continue };
            match write(path, &text()) {
                Ok(()) => written.tables.push((format, path)),
                Err(failed) => failures.push(failed),
            }
        }
        (written, failures)
    }
}

/// Returns the files that the report writes, with the names of their options.
fn outputs<'a>(args: &'a ReportArgs, page: &'a Path) -> [(&'static str, Option<&'a Path>); 3] {
    [
        ("--out", Some(page)),
        ("--csv", args.csv.as_deref()),
        ("--markdown", args.markdown.as_deref()),
    ]
}

/// Rejects outputs that cannot be written, or that would replace each other or a file that the command line names.
fn check_outputs(args: &ReportArgs, page: &Path) -> Result<(), Failed> {
    for file in [&args.csv, &args.markdown].into_iter().flatten() {
        output::check_directory_of(file)?;
    }
    output::check_is_no_directory(page)?;
    if !page.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("html")) {
        let shown = page.display();
        return Err(Failed::usage(format!("--out {shown}: the name must end in .html")));
    }
    let outputs = outputs(args, page);
    output::check_distinct(&outputs)?;
    for path in &args.evals {
        output::check_keeps(&outputs, ("--eval", path))?;
    }
    let teachers = args.composed_teachers.iter().map(|path| ("--composed-teachers", path));
    let filmed = args.film_strips.iter().map(|path| ("--film-strips", path));
    for (name, path) in teachers.chain(filmed) {
        // A policy that is missing is reported when it is read.
        if let Ok(file) = policy_file::file_of(path) {
            output::check_keeps(&outputs, (name, &file))?;
        }
    }
    Ok(())
}

/// Rejects outputs that would replace a file of a run or of trials.
fn check_no_input(outputs: &[(&str, Option<&Path>)], inputs: &ReportInputs) -> Result<(), Failed> {
    let named = outputs.iter().filter_map(|(name, path)| Some((name, (*path)?)));
    match named.into_iter().find(|(_, path)| inputs.contains(path)) {
        Some((name, path)) => Err(Failed::usage(format!(
            "{name} {}: it is a file of a run or of trials that the report reads; choose another",
            path.display()
        ))),
        None => Ok(()),
    }
}

/// Writes `text` to a file that the command line names.
fn write(path: &Path, text: &str) -> Result<(), Failed> {
    let written = atomic_file::replace_target(path, text.as_bytes());
    written.or_cannot_write(|| format!("cannot write {}", path.display()))
}

fn print(
    args: &ReportArgs,
    comparison: &Comparison,
    trials: &Trials,
    written: &Written<'_>,
) -> Result<(), Failed> {
    if args.json {
        let files = written.page.as_ref();
        let mut value = export::json(comparison);
        value["trials"] = trials::json(trials);
        value["report"] = json!(files.map(|files| files.page.to_string_lossy()));
        let plots = files.iter().flat_map(|files| &files.plots);
        value["figures"] = plots.map(|path| path.to_string_lossy()).collect();
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
    print_written(written)
}

/// Prints the paths of the files that were written.
fn print_written(written: &Written<'_>) -> Result<(), Failed> {
    if let Some(files) = &written.page {
        output::print(format_args!("report        {}", files.page.display()))?;
        if let Some(directory) = files.plots.first().and_then(|figure| figure.parent()) {
            let n_figures = counted(files.plots.len(), "file");
            output::print(format_args!("figures       {}: {n_figures}", directory.display()))?;
        }
    }
    for (format, path) in &written.tables {
        output::print(format_args!("{format:<13} {}", path.display()))?;
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
        let (test, more) = TestEvaluation::load(path).or_exit(Exit::Data, String::new)?;
        baselines.push(Baseline { label: stem(path), test });
        let label = |name| format!("{}, {name}", stem(path));
        baselines
            .extend(more.into_iter().map(|(name, test)| Baseline { label: label(name), test }));
    }
    for path in &args.composed_teachers {
        let teacher = policy_file::load(path)?;
        for task in advised_tasks(runs, teacher.task.name()) {
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
        interval: summary.interval,
        success_joint: summary.success_joint,
        success_per_arm: summary.success_per_arm.clone(),
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
