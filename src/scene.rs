//! `tandem scene`: prints the simulated world, and episodes in it, as data for other physics engines.

use anyhow::anyhow;
use serde::Serialize;
use tandem_core::rng::{Stream, episode_rng};
use tandem_core::{Contacts, Episode, Layout, Task, WorldSettings};
use tandem_sim::description::WorldDescription;
use tandem_sim::{Env, SimError, WorldConfig};

use crate::cli::{SceneArgs, check_layout, chosen_task};
use crate::evaluation::EvaluatedPolicy;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{input, output, policy_file};

/// The actions of an episode, shape `[steps][n_action]`.
type Actions = Vec<Vec<f32>>;

#[derive(Serialize)]
struct PrintedScene {
    world: WorldDescription,
    episodes: Vec<PrintedEpisode>,
}

/// An episode. Its vectors are those of a policy, in arm frames.
#[derive(Serialize)]
struct PrintedEpisode {
    /// Number of the episode, which determines start and goal together with the seed.
    number: u64,
    /// Shape `[n_goal]`.
    goal: Vec<f32>,
    /// Before the first step and after every step, shape `[steps + 1][n_observation]`.
    observations: Vec<Vec<f32>>,
    /// Shape `[steps][n_action]`.
    actions: Actions,
    /// Names of the contacts during each step.
    contacts: Vec<Vec<&'static str>>,
}

pub(crate) fn scene(args: &SceneArgs) -> Result<(), Failed> {
    let policy = policy(args)?;
    let layout = layout(args, policy.as_ref())?;
    let env = Env::new(layout, &WorldConfig::default()).or_exit(Exit::Usage, String::new)?;
    let episodes = match (&policy, &args.actions) {
        (Some(policy), _) => {
            policy.play(0..args.episodes, args.seed)?.iter().map(PrintedEpisode::of).collect()
        }
        (None, Some(path)) => {
            let text =
                input::text(path).or_exit(Exit::Usage, || format!("cannot read {path:?}"))?;
            let actions: Vec<Actions> = serde_json::from_str(&text).or_exit(Exit::Data, || {
                format!("{path:?} is not JSON of shape [episodes][steps][n_action]")
            })?;
            simulate(&env, args.seed, &actions)
                .map_err(|error| error.context(format!("{path:?}")))?
        }
        (None, None) => {
            let starts = vec![Actions::new(); usize::try_from(args.episodes).unwrap_or_default()];
            simulate(&env, args.seed, &starts)?
        }
    };
    let scene = PrintedScene { world: env.description(), episodes };
    let text = if args.json {
        serde_json::to_string(&scene)
    } else {
        serde_json::to_string_pretty(&scene)
    };
    output::print(text.or_exit(Exit::Bug, String::new)?)
}

fn policy(args: &SceneArgs) -> Result<Option<EvaluatedPolicy>, Failed> {
    Ok(match (&args.policy, &args.composed_teachers) {
        (Some(path), _) => Some(EvaluatedPolicy::new(policy_file::load(path)?, path)?),
        (None, Some(path)) => {
            let teacher = policy_file::load(path)?;
            let task = chosen_task(args.task, args.world)?;
            Some(EvaluatedPolicy::composed(teacher, (task, args.arms.unwrap_or(2)), path)?)
        }
        (None, None) => None,
    })
}

fn layout(args: &SceneArgs, policy: Option<&EvaluatedPolicy>) -> Result<Layout, Failed> {
    if let Some(policy) = policy {
        let layout = policy.layout();
        check_layout(layout, (args.task, args.world), args.arms)?;
        return Ok(layout);
    }
    let task = chosen_task(args.task, args.world)?.unwrap_or(Task::DEFAULT);
    Ok(Layout::new(task, args.arms.unwrap_or(2)))
}

/// Simulates the actions of each episode.
fn simulate(env: &Env, seed: u64, actions: &[Actions]) -> Result<Vec<PrintedEpisode>, Failed> {
    let simulate_one = |(number, actions): (u64, &Actions)| {
        simulate_episode(env.clone(), seed, number, actions).map_err(|error| {
            let exit = match error {
                SimError::StateNotFinite { .. } => Exit::Bug,
                _ => Exit::Data,
            };
            Failed::new(exit, anyhow!(error).context(format!("episode {number}")))
        })
    };
    (0..).zip(actions).map(simulate_one).collect()
}

fn simulate_episode(
    mut env: Env,
    seed: u64,
    number: u64,
    actions: &Actions,
) -> Result<PrintedEpisode, SimError> {
    env.reset(&mut episode_rng(seed, number, Stream::Reset), WorldSettings::default());
    let observe = |env: &Env| {
        let mut observation = vec![0.0; env.layout().n_observation()];
        env.observe(&mut observation);
        observation
    };
    let mut observations = vec![observe(&env)];
    let mut contacts = Vec::with_capacity(actions.len());
    for action in actions {
        contacts.push(names(env.step(action)?));
        observations.push(observe(&env));
    }
    Ok(PrintedEpisode {
        number,
        goal: env.goal().to_vec(),
        observations,
        actions: actions.clone(),
        contacts,
    })
}

impl PrintedEpisode {
    fn of(episode: &Episode) -> Self {
        let n_steps = episode.contacts.len();
        Self {
            number: episode.number,
            goal: episode.goal.clone(),
            observations: (0..=n_steps).map(|idx| episode.observation(idx).to_vec()).collect(),
            actions: (0..n_steps).map(|idx| episode.action(idx).to_vec()).collect(),
            contacts: episode.contacts.iter().map(|contacts| names(*contacts)).collect(),
        }
    }
}

fn names(contacts: Contacts) -> Vec<&'static str> {
    [(Contacts::ARM_ARM, "arm-arm"), (Contacts::ARM_TABLE, "arm-table")]
        .into_iter()
        .filter(|(contact, _)| contacts.contains(*contact))
        .map(|(_, name)| name)
        .collect()
}
