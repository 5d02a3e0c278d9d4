//! Pushing and grasping with both arms at once, from waypoints to the final positions of the objects.

use glam::DVec3;
use tandem_bridge::work_cell::mico_cell;
use tandem_trials::SimulatedConfig;
use tandem_trials::simulated::Block;

use crate::pair::observer::{Observer, Slack};
use crate::pair::rig::{Rig, planned, tools};

/// The height of the tool above the table, metres.
const WORK_M: f64 = 0.050;

/// A block for each arm, at these points of the base frames.
fn blocks(kinds: [fn([f32; 2]) -> Block; 2], at: [DVec3; 2]) -> Vec<Block> {
    let cell = mico_cell();
    (0..2)
        .map(|arm| {
            let at = cell.arms[arm].world_from_base().transform_point(&at[arm].into());
            let at = DVec3::from(at).as_vec3();
            kinds[arm]([at.x, at.y])
        })
        .collect()
}

/// The positions of the objects in the arms' base frames, metres.
fn in_base(rig: &Rig) -> [DVec3; 2] {
    let objects = rig.pair.borrow().objects();
    [0, 1].map(|arm| {
        let world_from_base = mico_cell().arms[arm].world_from_base();
        world_from_base.inverse_transform_point(&objects[arm].at_m.into()).into()
    })
}

fn both(point: [f64; 3]) -> [DVec3; 2] {
    [DVec3::from(point); 2]
}

fn path_error_m(rig: &Rig) -> f64 {
    let Some(reference) = rig.executor.reference() else { return 0.0 };
    let wanted = tools(&mico_cell(), reference);
    let are = tools(&mico_cell(), &rig.angles());
    wanted.iter().zip(are).map(|(wanted, is)| (*wanted - is).length()).fold(0.0, f64::max)
}

/// Pushes both blocks by 10 cm along `along` (base frame) with closed grippers.
fn push(kinds: [fn([f32; 2]) -> Block; 2], from: DVec3, along: DVec3, gap_m: f64) {
    let lengths: Vec<f64> = vec![0.0, 0.25, 0.5, 0.75, 1.0];
    let behind = [0, 1].map(|arm| {
        let block = kinds[arm]([0.0, 0.0]);
        from - along * (f64::from(block.half_m) + gap_m)
    });
    let at = |start_m: f64, way_m: f64, z_m: f64| {
        behind.map(|behind| (behind + along * (way_m - start_m)).with_z(z_m))
    };
    let mut points = vec![(at(0.02, 0.0, 0.13), 0.0), (at(0.02, 0.0, WORK_M), 0.0)];
    points.extend(lengths.iter().map(|share| (at(0.0, 0.1 * share, WORK_M), 0.0)));
    points.extend([(at(0.02, 0.1, WORK_M), 0.0), (at(0.02, 0.1, 0.13), 0.0)]);
    let motion = planned(&points);
    let blocks = blocks(kinds, [from; 2]);
    let mut rig = Rig::ready(&motion, SimulatedConfig { blocks, ..SimulatedConfig::default() });
    let mut observer = Observer::new(Slack::NONE);
    let mut worst_m = 0.0_f64;
    rig.play(motion, 1.0, |rig| {
        observer.look(&rig.pair.borrow(), "push");
        worst_m = worst_m.max(path_error_m(rig));
    });
    for at in in_base(&rig) {
        let off_m = at.with_z(0.0) - (from + along * 0.1).with_z(0.0);
        assert!(off_m.length() < 0.01, "{off_m}");
    }
    assert!(worst_m < 0.012, "{worst_m} m from where the motion has the tool, delay included");
}

#[test]
fn blocks_are_pushed_across() {
    push([Block::small, Block::large], DVec3::new(0.27, -0.05, 0.0), DVec3::Y, 0.010);
}

#[test]
fn blocks_are_pushed_away_from_the_bases() {
    push([Block::large, Block::small], DVec3::new(0.24, 0.0, 0.0), DVec3::X, 0.008);
}

#[test]
fn blocks_are_grasped_lifted_and_placed() {
    let from = DVec3::new(0.26, -0.03, 0.0);
    let to = DVec3::new(0.28, 0.05, 0.0);
    let at = |point: DVec3, z_m: f64| both(point.with_z(z_m).to_array());
    let points = vec![
        (at(from, 0.16), 1.0),
        (at(from, WORK_M), 1.0),
        (at(from, WORK_M), 0.0),
        (at(from, WORK_M + 0.10), 0.0),
        (at(to, WORK_M + 0.10), 0.0),
        (at(to, WORK_M + 0.001), 0.0),
        (at(to, WORK_M + 0.001), 1.0),
        (at(to, 0.16), 1.0),
    ];
    let motion = planned(&points);
    let blocks = blocks([Block::small, Block::large], [from; 2]);
    let halves_m = [0, 1].map(|arm: usize| f64::from(blocks[arm].half_m));
    let mut rig = Rig::ready(&motion, SimulatedConfig { blocks, ..SimulatedConfig::default() });
    let mut observer = Observer::new(Slack::NONE);
    let mut highest_m = [0.0_f64; 2];
    let mut worst_m = 0.0_f64;
    rig.play(motion, 1.0, |rig| {
        observer.look(&rig.pair.borrow(), "grasp");
        worst_m = worst_m.max(path_error_m(rig));
        for (highest_m, at) in highest_m.iter_mut().zip(in_base(rig)) {
            *highest_m = highest_m.max(at.z);
        }
    });
    for _ in 0..50 {
        rig.tick();
    }
    for (arm, at) in in_base(&rig).into_iter().enumerate() {
        let lifted_m = highest_m[arm] - halves_m[arm];
        let off_m = (at - to.with_z(halves_m[arm])).length();
        println!("lifted {:.1} mm, placed {:.1} mm off", lifted_m * 1e3, off_m * 1e3);
        assert!((0.09..0.12).contains(&lifted_m), "arm {arm}: lifted by {lifted_m} m");
        assert!(off_m < 0.01, "arm {arm}: {at}");
    }
    println!("behind the reference {:.1} mm", worst_m * 1e3);
    assert!(worst_m < 0.012);
}
