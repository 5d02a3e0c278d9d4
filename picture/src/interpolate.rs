//! Scenes between two control steps.

use tandem_core::scene::{ArmScene, Capsule, Cuboid, Point, Scene};

/// Returns the scene at `share`, in [0, 1], of the way from `before` to `after`, which are scenes of the same world.
/// Time, links, hands, end effectors and objects are interpolated; all else is that of `before`.
#[must_use]
pub fn between(before: &Scene, after: &Scene, share: f32) -> Scene {
    let arms = before.arms.iter().zip(&after.arms);
    let objects = before.objects.iter().zip(&after.objects);
    Scene {
        time_s: before.time_s + f64::from(share) * (after.time_s - before.time_s),
        arms: arms.map(|(before, after)| arm(before, after, share)).collect(),
        objects: objects.map(|(before, after)| cuboid(before, after, share)).collect(),
        ..before.clone()
    }
}

fn arm(before: &ArmScene, after: &ArmScene, share: f32) -> ArmScene {
    let links = before.links.iter().zip(&after.links);
    let hand = before.hand.iter().zip(&after.hand);
    ArmScene {
        links: links.map(|(before, after)| capsule(before, after, share)).collect(),
        hand: hand.map(|(before, after)| cuboid(before, after, share)).collect(),
        end_effector: point(before.end_effector, after.end_effector, share),
        ..before.clone()
    }
}

fn capsule(before: &Capsule, after: &Capsule, share: f32) -> Capsule {
    Capsule {
        from: point(before.from, after.from, share),
        to: point(before.to, after.to, share),
        radius_m: before.radius_m,
    }
}

/// Interpolates a box. Its orientation takes the shorter way; the painter normalises the quaternion.
fn cuboid(before: &Cuboid, after: &Cuboid, share: f32) -> Cuboid {
    let dot: f32 = before.orientation.iter().zip(after.orientation).map(|(a, b)| a * b).sum();
    let target = if dot < 0.0 { after.orientation.map(|x| -x) } else { after.orientation };
    Cuboid {
        centre: point(before.centre, after.centre, share),
        orientation: std::array::from_fn(|i| mix(before.orientation[i], target[i], share)),
        half_extents_m: before.half_extents_m,
    }
}

fn point(before: Point, after: Point, share: f32) -> Point {
    std::array::from_fn(|axis| mix(before[axis], after[axis], share))
}

fn mix(before: f32, after: f32, share: f32) -> f32 {
    before + share * (after - before)
}
