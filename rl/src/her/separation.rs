//! The distance between two arms whose parts come from different steps.

use tandem_core::{ArmIndex, TaskSpec};

/// A point of the horizontal plane, in the frame of the first arm.
type Point = [f32; 2];

/// Returns true if the first arm as in the first observation and the second arm as in the second one are apart by the
/// task's recombination gap.
///
/// With positions along one axis only, the gap is that along this axis. With positions in the plane, it is that between
/// the segments from each arm's base to its first position, and between every position of one arm and every position of
/// the other: arms may cross the middle side by side.
pub(super) fn are_apart(task: &TaskSpec, observations: [&[f32]; 2]) -> bool {
    let description = task.description();
    if task.lateral_of(ArmIndex(0)).is_empty() {
        let reach = |arm: usize| {
            let positions = task.position_of(ArmIndex(arm)).iter();
            positions.map(|idx| observations[arm][idx]).fold(f32::NEG_INFINITY, f32::max)
        };
        return description.origin_distance - (reach(0) + reach(1))
            >= description.recombination_gap;
    }
    let bases = [
        in_plane(description.origin_distance, 0, [description.base, 0.0]),
        in_plane(description.origin_distance, 1, [description.base, 0.0]),
    ];
    let points = |arm: usize| {
        let indices =
            task.position_of(ArmIndex(arm)).iter().zip(task.lateral_of(ArmIndex(arm)).iter());
        indices.map(move |(x, y)| {
            in_plane(description.origin_distance, arm, [observations[arm][x], observations[arm][y]])
        })
    };
    let squared_gap = description.recombination_gap * description.recombination_gap;
    let hands = [points(0).next(), points(1).next()];
    let [Some(first_hand), Some(second_hand)] = hands else { return false };
    squared_distance([bases[0], first_hand], [bases[1], second_hand]) >= squared_gap
        && points(0).all(|first| {
            points(1).all(|second| squared_length(difference(first, second)) >= squared_gap)
        })
}

/// Returns true if the hands of the first arm as in the first observation and of the second arm as in the second one are
/// so near to each other that they are in contact, as far as the task says.
pub(super) fn would_touch(task: &TaskSpec, observations: [&[f32]; 2]) -> bool {
    let description = task.description();
    if description.contact_distances.is_empty() {
        return false;
    }
    let [first, second] = [ArmIndex(0), ArmIndex(1)].map(|arm| {
        let hand = task.hand_of(arm).of(observations[arm.0]);
        let [x, y] = in_plane(description.origin_distance, arm.0, [hand[0], hand[1]]);
        [x, y, hand[2]]
    });
    let gaps = first.iter().zip(second).map(|(first, second)| (first - second).abs());
    gaps.zip(&description.contact_distances).all(|(gap, distance)| gap < *distance)
}

/// Converts a point from the frame of `arm` to that of the first arm. The arms face each other.
const fn in_plane(origin_distance: f32, arm: usize, [x, y]: Point) -> Point {
    if arm == 0 { [x, y] } else { [origin_distance - x, -y] }
}

const fn difference(a: Point, b: Point) -> Point {
    [a[0] - b[0], a[1] - b[1]]
}

const fn dot(a: Point, b: Point) -> f32 {
    a[0] * b[0] + a[1] * b[1]
}

const fn squared_length(a: Point) -> f32 {
    dot(a, a)
}

/// Returns the squared distance between two segments, 0 if they cross.
fn squared_distance(first: [Point; 2], second: [Point; 2]) -> f32 {
    if cross(first, second) {
        return 0.0;
    }
    let [a, b] = first;
    let [c, d] = second;
    [(a, second), (b, second), (c, first), (d, first)]
        .into_iter()
        .map(|(point, segment)| squared_distance_to_point(segment, point))
        .fold(f32::INFINITY, f32::min)
}

fn squared_distance_to_point([start, end]: [Point; 2], point: Point) -> f32 {
    let (along, offset) = (difference(end, start), difference(point, start));
    let squared = squared_length(along);
    let fraction = if squared > 0.0 { (dot(along, offset) / squared).clamp(0.0, 1.0) } else { 0.0 };
    let nearest = [start[0] + fraction * along[0], start[1] + fraction * along[1]];
    squared_length(difference(point, nearest))
}

/// Returns true if two segments cross at an inner point of both.
fn cross(first: [Point; 2], second: [Point; 2]) -> bool {
    let side = |[start, end]: [Point; 2], point: Point| {
        let (along, offset) = (difference(end, start), difference(point, start));
        along[0] * offset[1] - along[1] * offset[0]
    };
    let separates = |segment, [a, b]: [Point; 2]| side(segment, a) * side(segment, b) < 0.0;
    separates(first, second) && separates(second, first)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_core::task::TaskDescription;
    use tandem_core::{Layout, Task};

    const GAP: f32 = 0.16;

    /// Two arms with bases 0.52 m from the middle, hand and object in the plane.
    fn task() -> TaskSpec {
        let layout = Layout::new(Task::Push, 2);
        let mut description: TaskDescription = layout.description();
        description.name = "plane".to_owned();
        description.base = -0.40;
        description.recombination_gap = GAP;
        for (arm, part) in description.arms.iter_mut().zip([0, 28]) {
            arm.position = vec![part, part + 3];
            arm.lateral = vec![part + 1, part + 4];
            arm.hand = vec![part, part + 1, part + 2];
        }
        TaskSpec::new(description).unwrap()
    }

    /// Hand and object of each arm, arm frames.
    fn check(hands: [Point; 2], objects: [Point; 2], expected: bool) {
        let mut observation = vec![0.0; 56];
        for (arm, part) in [0, 28].into_iter().enumerate() {
            observation[part..part + 2].copy_from_slice(&hands[arm]);
            observation[part + 3..part + 5].copy_from_slice(&objects[arm]);
        }
        let apart = are_apart(&task(), [&observation, &observation]);
        assert_eq!(apart, expected, "hands {hands:?}, objects {objects:?}");
    }

    #[test]
    fn arms_that_pass_the_middle_side_by_side_are_apart() {
        let objects = [[-0.1, 0.2], [-0.1, 0.2]];
        check([[0.15, 0.12], [0.15, 0.12]], objects, true);
        check([[0.15, 0.02], [0.15, 0.02]], objects, false);
    }

    #[test]
    fn arms_that_cross_are_not_apart_even_if_their_hands_are() {
        // The hands are 0.28 m apart in y; the segments from the bases cross.
        let objects = [[-0.1, 0.25], [-0.1, 0.25]];
        check([[0.20, 0.14], [0.20, -0.14]], objects, false);
    }

    #[test]
    fn an_object_near_the_other_arms_hand_prevents_recombination() {
        let hands = [[-0.1, 0.0], [-0.1, 0.0]];
        // In the second arm's frame the first hand is at x = 0.34.
        check(hands, [[0.0, 0.2], [0.0, 0.2]], true);
        check(hands, [[0.0, 0.2], [0.30, 0.0]], false);
    }

    #[test]
    fn hands_touch_that_are_near_along_all_axes() {
        let mut description = task().description().clone();
        description.contact_distances = vec![0.065, 0.08, 0.15];
        let described = TaskSpec::new(description).unwrap();
        let middle = 0.5 * described.description().origin_distance;
        // In their own frames: the second arm faces the first one.
        for (first, second, expected) in [
            ([middle, 0.0, 0.1], [middle, 0.0, 0.1], true),
            ([middle, 0.04, 0.1], [middle - 0.06, 0.03, 0.2], true),
            ([middle, 0.0, 0.1], [middle - 0.07, 0.0, 0.1], false),
            ([middle, 0.04, 0.1], [middle, 0.05, 0.1], false),
            ([middle, 0.0, 0.3], [middle, 0.0, 0.1], false),
        ] {
            let mut observation = vec![0.0; 56];
            observation[..3].copy_from_slice(&first);
            observation[28..31].copy_from_slice(&second);
            let both = [observation.as_slice(), &observation];
            assert_eq!(would_touch(&described, both), expected, "{first:?}, {second:?}");
            assert!(!would_touch(&task(), both), "a task that does not say so");
        }
    }

    #[test]
    fn the_order_of_the_arms_does_not_matter() {
        let objects = [[0.05, 0.2], [-0.1, 0.1]];
        for y in [-0.2, -0.1, 0.0, 0.1, 0.2] {
            let hands: [Point; 2] = [[0.1, y], [0.12, 0.05]];
            let mut observation = vec![0.0; 56];
            let mut exchanged = observation.clone();
            for (arm, part) in [0, 28].into_iter().enumerate() {
                observation[part..part + 2].copy_from_slice(&hands[arm]);
                observation[part + 3..part + 5].copy_from_slice(&objects[arm]);
                exchanged[part..part + 2].copy_from_slice(&hands[1 - arm]);
                exchanged[part + 3..part + 5].copy_from_slice(&objects[1 - arm]);
            }
            let one = are_apart(&task(), [&observation, &observation]);
            assert_eq!(one, are_apart(&task(), [&exchanged, &exchanged]), "y = {y}");
        }
    }
}
