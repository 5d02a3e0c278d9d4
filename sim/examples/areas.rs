//! Prints a picture (SVG) of the table of two arms from above: where the hands move, and drawn objects and goals.
//!
//! `cargo run --release -p tandem-sim --example areas -- shared-push > shared-push.svg`
#![expect(clippy::print_stdout, reason = "its output")]

use std::fmt::Write as _;

use tandem_core::layout::WORKSPACE_DISTANCE_M;
use tandem_core::{Layout, Stream, Task, World, WorldSettings, episode_rng};
use tandem_sim::reach::Reach;
use tandem_sim::{Env, WorldConfig};

const N_STARTS: u64 = 150;
/// Pixels per metre.
const SCALE: f32 = 700.0;
/// Half the width and half the height of the picture, metres.
const HALF_M: [f32; 2] = [0.52, 0.32];
/// Colours of the arms.
const COLORS: [&str; 2] = ["#1f77b4", "#d1495b"];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let task: Task = std::env::args().nth(1).as_deref().unwrap_or("shared-push").parse()?;
    let mut env = Env::new(Layout::new(task, 2), &WorldConfig::default())?;
    let mut picture = String::new();
    let [width, height] = HALF_M.map(|half_m| 2.0 * half_m * SCALE);
    writeln!(
        picture,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" \
         font-family=\"sans-serif\" font-size=\"15\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>"
    )?;
    for arm in 0..2 {
        draw_workspace(&mut picture, &env, arm)?;
    }
    for episode in 0..N_STARTS {
        env.reset(&mut episode_rng(1, episode, Stream::Reset), WorldSettings::default());
        let scene = env.scene();
        for (arm, color) in COLORS.into_iter().enumerate() {
            let [x, y] = pixels(scene.objects[arm].centre[0], scene.objects[arm].centre[1]);
            writeln!(
                picture,
                "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"6\" height=\"6\" fill=\"{color}\"/>",
                x - 3.0,
                y - 3.0
            )?;
            let [x, y] = pixels(scene.goals[arm][0], scene.goals[arm][1]);
            writeln!(
                picture,
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3.5\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.5\"/>"
            )?;
        }
    }
    writeln!(
        picture,
        "<rect width=\"100%\" height=\"54\" fill=\"white\"/>\n\
         <text x=\"14\" y=\"24\">{task}: {N_STARTS} starts from above. Squares: objects, circles: goals,</text>\n\
         <text x=\"14\" y=\"44\">boxes: positions of the hands, arcs: reach of a Mico.</text>\n<line x1=\"14\" y1=\"{0:.0}\" x2=\"{1:.0}\" \
         y2=\"{0:.0}\" stroke=\"black\" stroke-width=\"3\"/>\n<text x=\"14\" y=\"{2:.0}\">10 cm</text>\n</svg>",
        height - 14.0,
        14.0 + 0.1 * SCALE,
        height - 22.0
    )?;
    print!("{picture}");
    Ok(())
}

/// Draws the box of an arm's hand and, in the shared world, the base of its Mico and its reach at the table.
fn draw_workspace(picture: &mut String, env: &Env, arm: usize) -> std::fmt::Result {
    let hand = env.description().hand;
    let corners =
        [hand.workspace_low_m, hand.workspace_high_m].map(|own| in_world(arm, own[0], own[1]));
    let [[x0, y0], [x1, y1]] = corners.map(|[x, y]| pixels(x, y));
    let color = COLORS[arm];
    writeln!(
        picture,
        "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"{color}\" fill-opacity=\"0.08\" \
         stroke=\"{color}\"/>",
        x0.min(x1),
        y0.min(y1),
        (x1 - x0).abs(),
        (y1 - y0).abs()
    )?;
    let world = env.layout().task.world();
    if world != World::Shared {
        return Ok(());
    }
    let [base_x, base_y] = in_world(arm, -world.mico_base_distance_m(), 0.0);
    let [x, y] = pixels(base_x, base_y);
    writeln!(picture, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"12\" fill=\"{color}\"/>")?;
    for radius_m in Reach::MICO.radii_m(0.0) {
        writeln!(
            picture,
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{:.1}\" fill=\"none\" stroke=\"{color}\" \
             stroke-dasharray=\"6 5\"/>",
            radius_m * SCALE
        )?;
    }
    Ok(())
}

/// Converts a position from an arm's frame to the world frame, metres.
fn in_world(arm: usize, x: f32, y: f32) -> [f32; 2] {
    let sign = if arm == 0 { 1.0 } else { -1.0 };
    [sign * (x - 0.5 * WORKSPACE_DISTANCE_M), sign * y]
}

/// Converts a position in the world frame to pixels.
fn pixels(x: f32, y: f32) -> [f32; 2] {
    [(HALF_M[0] + x) * SCALE, (HALF_M[1] - y) * SCALE]
}
