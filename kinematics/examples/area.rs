//! Prints the share of the tasks' area that the Mico with four joints reaches, and the tilt of its gripper there.
#![expect(clippy::print_stdout, reason = "its output")]

use nalgebra::Point3;
use tandem_core::rng::uniform;
use tandem_core::{Stream, episode_rng};
use tandem_kinematics::{Joints, MICO_4, TaskFrame, ToolTarget, WorkCell};

const N_POINTS: u32 = 20_000;
const TILTS_DEG: [f64; 6] = [10.0, 15.0, 20.0, 25.0, 30.0, 40.0];
/// Half the area of objects and goals along x and y, training world, metres.
const AREA_M: f32 = 0.12;
/// Heights of the tool: working on the table, and up to the highest goal.
const HEIGHTS_M: [[f32; 2]; 2] = [[0.022, 0.06], [0.022, 0.27]];

fn main() {
    print!("scale  base  lift  heights           reached");
    println!("{}", TILTS_DEG.map(|tilt| format!("  <={tilt:>2}°")).concat());
    for scale in [0.5, 0.6, 0.7, 0.8, 1.0] {
        for centre_m in [0.25, 0.27, 0.29, 0.40] {
            for heights_m in HEIGHTS_M {
                print_row(TaskFrame { scale, centre_m, lift_m: 0.045 }, heights_m);
            }
        }
    }
    println!("the default:");
    for heights_m in HEIGHTS_M {
        print_row(TaskFrame::MICO_4, heights_m);
    }
}

/// Prints shares of points drawn uniformly from the area.
fn print_row(frame: TaskFrame, heights_m: [f32; 2]) {
    let mut rng = episode_rng(1, 0, Stream::Reset);
    let seed = Joints::new(MICO_4.elbow_up_rad);
    let (mut reached, mut within) = (0, [0; TILTS_DEG.len()]);
    for _ in 0..N_POINTS {
        let mut between = |low, high| f64::from(uniform(&mut rng, low, high));
        let (x, y) = (between(-AREA_M, AREA_M), between(-AREA_M, AREA_M));
        let in_arm = Point3::new(x, y, between(heights_m[0], heights_m[1]));
        let position_m = frame.base_from_arm(&in_arm);
        let target = ToolTarget { position_m, yaw_rad: WorkCell::FINGERS_YAW_RAD };
        if let Ok(solution) = MICO_4.inverse_kinematics(&target, &seed) {
            reached += 1;
            for (count, tilt) in within.iter_mut().zip(TILTS_DEG) {
                *count += u32::from(solution.tilt_rad.to_degrees() <= tilt);
            }
        }
    }
    let percent = |count: u32| 100.0 * f64::from(count) / f64::from(N_POINTS);
    let [low, high] = heights_m;
    print!("{:>5} {:>5} {:>5}  {low:.3} to {high:.3} m", frame.scale, frame.centre_m, frame.lift_m);
    print!("  {:>6.1}", percent(reached));
    println!("{}", within.map(|count| format!(" {:>6.1}", percent(count))).concat());
}
