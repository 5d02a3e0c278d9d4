//! A scene as shapes of a picture, from back to front.
//!
//! The ray caster of `tandem_picture` takes longer for a picture than a control step lasts. The page fills these shapes
//! instead, in the same view.

use serde_json::{Value, json};
use tandem_core::scene::{ArmScene, Capsule, Cuboid, Point, Scene};
use tandem_picture::View;

/// Direction towards the light, a unit vector.
const LIGHT: [f64; 3] = [-0.36, -0.48, 0.80];
/// Half the lengths of the edges of a pedestal, metres.
const PEDESTAL_HALF_M: [f32; 3] = [0.075, 0.075, 0.0175];
/// Ratio of the radius of a joint to that of its links.
const JOINT_WIDENING: f32 = 1.12;
/// Corners of a circle on the table.
const N_CORNERS: u8 = 48;
/// The corners of a square, around it.
const SQUARE: [[f32; 2]; 4] = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];

/// Returns the shapes of `scene` in a picture of this size, places in pixels from the upper left corner:
///
/// - `table`: faces of the table; `top`: the corners of its top
/// - `shadows`: polygons (`points`) and lines (`from`, `to`, `width`) on the table
/// - `rings`: for each goal a polygon on the table below it
/// - `items`: faces (`points`, `shade`), lines (`from`, `to`, `width`), joints (`centre`, `radius`) and goals (`centre`,
///   `radius`, `foot`, `is_achieved`), from back to front; `of` is what they belong to, `arm` the index of its arm
#[must_use]
pub(crate) fn drawing(scene: &Scene, achieved: &[bool], width: usize, height: usize) -> Value {
    let mut drawing = Drawing {
        view: View::of(scene, width, height),
        table_z_m: scene.table.centre[2] + scene.table.half_extents_m[2],
        items: Vec::new(),
        shadows: Vec::new(),
    };
    drawing.add_cuboid(&scene.table, "table", 0);
    let table = drawing.take_items();
    let top = face(2, 1.0).map(|signs| drawing.view.project(corner(&scene.table, signs)));
    drawing.shadows.clear();
    for (arm_idx, arm) in scene.arms.iter().enumerate() {
        drawing.add_arm(arm, arm_idx);
    }
    for (idx, object) in scene.objects.iter().enumerate() {
        drawing.add_cuboid(object, "object", idx);
    }
    let goals = || scene.goals.iter().zip(achieved.iter().copied().chain(std::iter::repeat(false)));
    for (idx, (goal, is_achieved)) in goals().enumerate() {
        drawing.add_goal(*goal, scene.goal_tolerance_m, idx, is_achieved);
    }
    let ring = |goal: &Point| drawing.ring(*goal, scene.goal_tolerance_m);
    let rings: Vec<Value> = scene.goals.iter().map(ring).collect();
    let items = drawing.take_items();
    json!({ "table": table, "top": top, "shadows": drawing.shadows, "rings": rings, "items": items })
}

struct Drawing {
    view: View,
    table_z_m: f32,
    /// Shapes with their depths.
    items: Vec<(f64, Value)>,
    shadows: Vec<Value>,
}

impl Drawing {
    /// Removes all items, from back to front.
    fn take_items(&mut self) -> Vec<Value> {
        let mut items = std::mem::take(&mut self.items);
        items.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        items.into_iter().map(|(_, item)| item).collect()
    }

    fn add_arm(&mut self, arm: &ArmScene, idx: usize) {
        let [x, y, z] = arm.base;
        let pedestal = Cuboid {
            centre: [x, y, z + PEDESTAL_HALF_M[2]],
            orientation: [0.0, 0.0, 0.0, 1.0],
            half_extents_m: PEDESTAL_HALF_M,
        };
        self.add_cuboid(&pedestal, "pedestal", idx);
        // A first link that begins at the base has no post, and no joint with it.
        let post = arm.links.first().filter(|link| link.from != arm.base);
        let post = post.map(|link| Capsule { from: arm.base, to: link.from, ..*link });
        let mut links: Vec<Capsule> = post.into_iter().chain(arm.links.iter().copied()).collect();
        // The round end of the lowest one is drawn over the pedestal, so it ends there.
        if let Some(lowest) = links.first_mut() {
            lowest.from[2] += lowest.radius_m;
        }
        for link in &links {
            self.add_capsule(link, "link", idx);
        }
        for pair in links.windows(2) {
            let [link, next] = pair else { continue };
            self.add_joint(link, next, idx);
        }
        for part in &arm.hand {
            self.add_cuboid(part, "hand", idx);
        }
    }

    fn add_capsule(&mut self, capsule: &Capsule, of: &str, arm: usize) {
        let middle = between(capsule.from, capsule.to);
        let width = 2.0 * f64::from(capsule.radius_m) * self.view.pixels_per_m(middle);
        let [from, to] = [capsule.from, capsule.to].map(|end| self.view.project(end));
        let item = json!({ "of": of, "arm": arm, "from": from, "to": to, "width": width });
        self.items.push((self.view.depth_m(middle), item));
        let [from, to] = [capsule.from, capsule.to].map(|end| self.view.project(self.shadow(end)));
        self.shadows.push(json!({ "from": from, "to": to, "width": 0.9 * width }));
    }

    /// Adds the joint at the end of `link`, in front of both links that it joins.
    fn add_joint(&mut self, link: &Capsule, next: &Capsule, arm: usize) {
        let (centre, radius_m) = (link.to, JOINT_WIDENING * link.radius_m.max(next.radius_m));
        let radius = f64::from(radius_m) * self.view.pixels_per_m(centre);
        let place = self.view.project(centre);
        let item = json!({ "of": "joint", "arm": arm, "centre": place, "radius": radius });
        let middles = [link, next].map(|it| self.view.depth_m(between(it.from, it.to)));
        let depth_m = self.view.depth_m(centre).min(middles[0]).min(middles[1]);
        self.items.push((depth_m - f64::from(radius_m), item));
    }

    /// Adds the faces of a box that the camera sees.
    fn add_cuboid(&mut self, cuboid: &Cuboid, of: &str, arm: usize) {
        for (axis, sign) in (0..3).flat_map(|axis| [(axis, -1.0), (axis, 1.0)]) {
            let mut unit = [0.0; 3];
            unit[axis] = sign;
            let normal = rotated(cuboid.orientation, unit);
            let corners = face(axis, sign).map(|signs| corner(cuboid, signs));
            let centre = between(corners[0], corners[2]);
            if !self.faces_camera(centre, normal) {
                continue;
            }
            let facing = dot(normal.map(f64::from), LIGHT).max(0.0);
            let item = json!({
                "of": of, "arm": arm, "points": corners.map(|it| self.view.project(it)),
                "shade": 0.60 + 0.07 * f64::from(normal[2]) + 0.46 * facing,
            });
            self.items.push((self.view.depth_m(centre), item));
        }
        let corners = face(2, -1.0).into_iter().chain(face(2, 1.0));
        let shadow = corners.map(|signs| self.view.project(self.shadow(corner(cuboid, signs))));
        self.shadows.push(json!({ "points": hull(shadow.collect()) }));
    }

    fn add_goal(&mut self, goal: Point, tolerance_m: f32, arm: usize, is_achieved: bool) {
        let item = json!({
            "of": "goal", "arm": arm, "is_achieved": is_achieved, "centre": self.view.project(goal),
            "radius": f64::from(tolerance_m) * self.view.pixels_per_m(goal),
            "foot": self.view.project([goal[0], goal[1], self.table_z_m]),
        });
        self.items.push((self.view.depth_m(goal), item));
    }

    /// Returns the circle on the table below a goal.
    fn ring(&self, [x, y, _]: Point, radius_m: f32) -> Value {
        let corner = |idx: u8| {
            let angle_rad = std::f32::consts::TAU * f32::from(idx) / f32::from(N_CORNERS);
            let (sin, cos) = angle_rad.sin_cos();
            self.view.project([x + radius_m * cos, y + radius_m * sin, self.table_z_m])
        };
        json!((0..N_CORNERS).map(corner).collect::<Vec<_>>())
    }

    /// Returns whether the camera sees the front of a face.
    fn faces_camera(&self, centre: Point, normal: [f32; 3]) -> bool {
        let eye = self.view.eye();
        let towards = std::array::from_fn(|axis| eye[axis] - f64::from(centre[axis]));
        dot(normal.map(f64::from), towards) > 0.0
    }

    /// Returns where the shadow of a point falls on the table.
    #[expect(clippy::cast_possible_truncation, reason = "metres")]
    fn shadow(&self, point: Point) -> Point {
        let height_m = (point[2] - self.table_z_m).max(0.0);
        let [along_x, along_y] = [0, 1].map(|axis| (LIGHT[axis] / LIGHT[2]) as f32 * height_m);
        [point[0] - along_x, point[1] - along_y, self.table_z_m]
    }
}

/// Returns the corners of a face of a cube, around it, by the signs of their coordinates.
fn face(axis: usize, sign: f32) -> [[f32; 3]; 4] {
    SQUARE.map(|[u, v]| match axis {
        0 => [sign, u, v],
        1 => [u, sign, v],
        _ => [u, v, sign],
    })
}

fn corner(cuboid: &Cuboid, signs: [f32; 3]) -> Point {
    let offset = std::array::from_fn(|axis| signs[axis] * cuboid.half_extents_m[axis]);
    let turned = rotated(cuboid.orientation, offset);
    std::array::from_fn(|axis| cuboid.centre[axis] + turned[axis])
}

/// Rotates a vector by a quaternion (x, y, z, w), which need not have length 1.
fn rotated([x, y, z, w]: [f32; 4], v: [f32; 3]) -> [f32; 3] {
    let scale = 2.0 / (x * x + y * y + z * z + w * w).max(f32::MIN_POSITIVE);
    let t = [y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]];
    let cross = [y * t[2] - z * t[1], z * t[0] - x * t[2], x * t[1] - y * t[0]];
    std::array::from_fn(|axis| v[axis] + scale * (w * t[axis] + cross[axis]))
}

fn between(a: Point, b: Point) -> Point {
    std::array::from_fn(|axis| 0.5 * (a[axis] + b[axis]))
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Returns the convex hull of points in the plane, in order around it (Andrew's monotone chain).
fn hull(mut points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let mut hull = chain(points.iter());
    hull.extend(chain(points.iter().rev()));
    hull
}

/// Returns one side of a convex hull without its last point.
fn chain<'a>(points: impl Iterator<Item = &'a [f64; 2]>) -> Vec<[f64; 2]> {
    let mut side: Vec<[f64; 2]> = Vec::new();
    for point in points {
        while let [.., a, b] = side.as_slice()
            && (b[0] - a[0]) * (point[1] - a[1]) <= (b[1] - a[1]) * (point[0] - a[0])
        {
            side.pop();
        }
        side.push(*point);
    }
    side.pop();
    side
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hull_goes_around_all_points() {
        let square = [[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [2.0, 2.0], [0.0, 2.0], [1.0, 0.0]];
        assert_eq!(hull(square.to_vec()), [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]);
    }

    #[test]
    fn an_arm_has_joints_between_its_links_only() {
        let link = |low: f32, high: f32| Capsule {
            from: [0.0, 0.0, low],
            to: [0.0, 0.0, high],
            radius_m: 0.05,
        };
        let n_joints = |links: Vec<Capsule>| {
            let arm = ArmScene {
                base: [0.0; 3],
                joint_angles_rad: [0.0; 6],
                joint_points: Vec::new(),
                links,
                hand: Vec::new(),
                end_effector: [0.0; 3],
            };
            let table = Cuboid {
                centre: [0.0, 0.0, -0.1],
                orientation: [0.0, 0.0, 0.0, 1.0],
                half_extents_m: [1.0, 1.0, 0.1],
            };
            let scene = Scene {
                time_s: 0.0,
                arms: vec![arm],
                objects: Vec::new(),
                goals: Vec::new(),
                goal_tolerance_m: 0.05,
                table,
            };
            let shapes = drawing(&scene, &[], 640, 400);
            shapes["items"]
                .as_array()
                .map(|items| items.iter().filter(|it| it["of"] == "joint").count())
        };
        assert_eq!(n_joints(vec![link(0.0, 0.3), link(0.3, 0.6)]), Some(1));
        assert_eq!(n_joints(vec![link(0.2, 0.3), link(0.3, 0.6)]), Some(2), "with a post");
    }

    #[test]
    fn a_quarter_of_a_turn_about_z_takes_x_to_y() {
        let turned = rotated([0.0, 0.0, 1.0, 1.0], [1.0, 0.0, 0.5]);
        assert!(turned.iter().zip([0.0, 1.0, 0.5]).all(|(a, b)| (a - b).abs() < 1e-6));
    }
}
