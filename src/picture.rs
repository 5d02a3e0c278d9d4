//! `tandem picture`: renders a step of an episode as an SVG picture.

use tandem_core::WorldSettings;
use tandem_core::rng::{Stream, episode_rng};
use tandem_report::View;
use tandem_sim::{Env, WorldConfig};

use crate::cli::PictureArgs;
use crate::evaluation::EvaluatedPolicy;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, policy_file};

pub(crate) fn picture(args: &PictureArgs) -> Result<(), Failed> {
    let subject = match (&args.policy, &args.composed_teachers) {
        (Some(path), _) => EvaluatedPolicy::new(policy_file::load(path)?, path)?,
        (None, Some(path)) => EvaluatedPolicy::composed(policy_file::load(path)?, 2, path)?,
        (None, None) => return Err(Failed::usage("give --policy or --composed-teachers")),
    };
    let episode = subject.play(1, args.seed)?.remove(0);
    let mut world =
        Env::new(subject.layout(), &WorldConfig::default()).or_exit(Exit::Bug, String::new)?;
    world.reset(&mut episode_rng(args.seed, 0, Stream::Reset), WorldSettings::default());
    for step_idx in 0..args.step as usize {
        world.step(episode.action(step_idx)).or_exit(Exit::Bug, String::new)?;
    }
    let svg = tandem_report::scene_svg(&world.scene(), &View::default());
    std::fs::write(&args.out, svg)
        .or_cannot_write(|| format!("cannot write {}", args.out.display()))?;
    output::print(args.out.display())?;
    Ok(())
}
