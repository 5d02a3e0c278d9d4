//! Displacements of the bodies of a scene.

use tandem_core::reward::distance;
use tandem_core::scene::{Cuboid, Scene};

/// Returns a distance, metres, by which no point of a link, a hand or an object has moved more between two scenes of the
/// same world.
pub(crate) fn motion_m(one: &Scene, other: &Scene) -> f32 {
    let arms = || one.arms.iter().zip(&other.arms);
    let links = arms().flat_map(|(a, b)| a.links.iter().zip(&b.links));
    let links = links.map(|(a, b)| distance(&a.from, &b.from).max(distance(&a.to, &b.to)));
    let hands = arms().flat_map(|(a, b)| a.hand.iter().zip(&b.hand));
    let cuboids = hands.chain(one.objects.iter().zip(&other.objects));
    links.chain(cuboids.map(|(a, b)| motion_of_cuboid_m(a, b))).fold(0.0, f32::max)
}

fn motion_of_cuboid_m(one: &Cuboid, other: &Cuboid) -> f32 {
    let radius_m = distance(&one.half_extents_m, &[0.0; 3]);
    // The angle between two orientations is about twice the distance of their quaternions, of which either sign is meant.
    let opposite = other.orientation.map(|x| -x);
    let turned = distance(&one.orientation, &other.orientation);
    let turned = 2.0 * turned.min(distance(&one.orientation, &opposite));
    distance(&one.centre, &other.centre) + turned * radius_m
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_moves_the_corners_of_a_box() {
        let cuboid = Cuboid {
            centre: [0.0; 3],
            orientation: [0.0, 0.0, 0.0, 1.0],
            half_extents_m: [0.03, 0.04, 0.0],
        };
        let half_rad: f32 = 0.01;
        let turned = Cuboid { orientation: [0.0, 0.0, -half_rad.sin(), -half_rad.cos()], ..cuboid };
        let moved_m = motion_of_cuboid_m(&cuboid, &turned);
        assert!((moved_m - 2.0 * half_rad * 0.05).abs() < 1e-6, "{moved_m}");
        let shifted = Cuboid { centre: [0.0, 0.1, 0.0], ..cuboid };
        assert!((motion_of_cuboid_m(&cuboid, &shifted) - 0.1).abs() < 1e-6);
    }
}
