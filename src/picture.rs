//! `tandem picture`: draws a step of an episode as a PNG picture.

use tandem_picture::picture_png;
use tandem_system::atomic_file;

use crate::cli::PictureArgs;
use crate::evaluation::EvaluatedPolicy;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{film, output, policy_file};

pub(crate) fn picture(args: &PictureArgs) -> Result<(), Failed> {
    if args.out.extension().is_none_or(|ending| !ending.eq_ignore_ascii_case("png")) {
        return Err(Failed::usage(format!(
            "--out {}: the name must end in .png",
            args.out.display()
        )));
    }
    let subject = match (&args.policy, &args.composed_teachers) {
        (Some(path), _) => EvaluatedPolicy::new(policy_file::load(path)?, path)?,
        (None, Some(path)) => EvaluatedPolicy::composed(policy_file::load(path)?, (None, 2), path)?,
        (None, None) => return Err(Failed::usage("give --policy or --composed-teachers")),
    };
    let episode = subject.play(0..1, args.seed)?.remove(0);
    let film = film::of_evaluation(subject.layout(), args.seed, &episode)?;
    let step = film.steps.get(args.step as usize).or_else(|| film.steps.last());
    let step = step.ok_or_else(|| Failed::usage("the episode has no steps"))?;
    let png = picture_png("", step, (args.size.width, args.size.height));
    let png = png.or_exit(Exit::Usage, || "--size".to_owned())?;
    atomic_file::replace_target(&args.out, &png)
        .or_cannot_write(|| format!("cannot write {}", args.out.display()))?;
    output::print(args.out.display())?;
    Ok(())
}
