//! Draws a scene by casting rays.
//!
//! A ray caster draws bodies that penetrate each other, such as fingers around an object, in the right order at every
//! pixel.

use glam::{DVec2, DVec3};
use tandem_core::scene::{ArmScene, Capsule, Cuboid, Scene};

use crate::camera::{Camera, Rectangle, table_z_m};
use crate::raster::Raster;
use crate::shape::{Hit, Shape};
use crate::tiles::{Tile, Tiles};

/// Red, green and blue, 0 to 255.
type Rgb = DVec3;

/// Colours of the arms' joints and of their objects and goals; further arms reuse them.
const ARM_COLORS: [Rgb; 3] = [
    DVec3::new(47.0, 120.0, 189.0),
    DVec3::new(224.0, 128.0, 51.0),
    DVec3::new(60.0, 154.0, 102.0),
];
/// Parts of an object that no arm brings to its goal.
const PART_COLOR: Rgb = DVec3::new(150.0, 156.0, 163.0);
const TABLE_COLOR: Rgb = DVec3::new(233.0, 228.0, 219.0);
const LINK_COLOR: Rgb = DVec3::new(238.0, 240.0, 243.0);
const HAND_COLOR: Rgb = DVec3::new(74.0, 82.0, 92.0);
const PEDESTAL_COLOR: Rgb = DVec3::new(89.0, 97.0, 107.0);
const BACKGROUND: Rgb = DVec3::new(246.0, 248.0, 250.0);
const WHITE: Rgb = DVec3::splat(255.0);
/// Share of an arm's colour in that of its links.
const LINK_TINT: f64 = 0.16;
/// Direction towards the light, a unit vector.
const LIGHT: DVec3 = DVec3::new(-0.36, -0.48, 0.80);
/// Radius of the light as seen from the table, radians, which gives shadows a soft edge.
const LIGHT_RADIUS: f64 = 0.028;
/// Number of points of the light that a shadow on the table is computed from.
const N_LIGHT_POINTS: u8 = 7;
/// Allowance for the longer ways of rays from points beside the centre of the light.
const SOFT_WIDENING: f64 = 1.2;
/// Brightness of a surface in shadow relative to the same surface in light.
const SHADOW: f64 = 0.80;
/// Opacity of goals, and of goals that are achieved.
const GOAL_OPACITIES: [f64; 2] = [0.30, 0.52];
/// Share of white in the brightest point of a highlight, and its sharpness.
const HIGHLIGHT: f64 = 0.42;
const SHARPNESS: i32 = 24;
/// Half the width of the ring on the table below a goal, metres.
const RING_HALF_WIDTH_M: f64 = 0.0016;
/// Half the lengths of the edges of a pedestal, metres.
const PEDESTAL_HALF_M: [f32; 3] = [0.075, 0.075, 0.0175];
/// Ratio of the radius of a joint to that of its links.
const JOINT_WIDENING: f64 = 1.12;
/// Samples along each edge of a pixel at the edge of a body.
const N_SAMPLES: usize = 3;
/// Distance from a surface at which the rays of its shadow start, metres.
const SHADOW_OFFSET_M: f64 = 1e-4;
/// Allowance for rounding and [`SHADOW_OFFSET_M`] when bodies are chosen whose shadows may fall on another, metres.
const BLOCKER_MARGIN_M: f64 = 1e-3;
/// Index of the table among the bodies.
const TABLE: usize = 0;

/// Draws `scene` in a picture of `width` times `height` pixels, as [`View::of`](crate::View::of) projects it.
#[must_use]
pub fn render(scene: &Scene, width: usize, height: usize) -> Raster {
    render_achieved(scene, &[], width, height)
}

/// Draws `scene`; `achieved` contains which goals are achieved and have a stronger colour.
pub(crate) fn render_achieved(
    scene: &Scene,
    achieved: &[bool],
    width: usize,
    height: usize,
) -> Raster {
    let painter = Painter::new(scene, achieved, width, height);
    let mut rgb = Vec::with_capacity(3 * width * height);
    let mut surfaces = Vec::with_capacity(width * height);
    for (x, y) in pixels(width, height) {
        let sample = painter.sample(painter.tiles.at(x, y), centre(x), centre(y));
        rgb.extend(sample.color.to_array().map(to_u8));
        surfaces.push(sample.surface.packed());
    }
    for (x, y) in pixels(width, height) {
        let idx = y * width + x;
        let (right, below) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
        let (left, above) = (x.saturating_sub(1), y.saturating_sub(1));
        let neighbours =
            [y * width + right, y * width + left, below * width + x, above * width + x];
        if neighbours.iter().any(|neighbour| surfaces[*neighbour] != surfaces[idx]) {
            let color = painter.smooth(x, y).to_array().map(to_u8);
            rgb[3 * idx..3 * idx + 3].copy_from_slice(&color);
        }
    }
    Raster { width, height, rgb }
}

fn pixels(width: usize, height: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..height).flat_map(move |y| (0..width).map(move |x| (x, y)))
}

/// Returns the centre of a pixel.
#[expect(clippy::cast_precision_loss, reason = "pixels of a picture that fits into memory")]
fn centre(pixel: usize) -> f64 {
    pixel as f64 + 0.5
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to 0..=255 first"
)]
fn to_u8(value: f64) -> u8 {
    (value.clamp(0.0, 255.0) + 0.5) as u8
}

/// A body with its colour and the part of the picture that contains it.
struct Body {
    shape: Shape,
    color: Rgb,
    bounds: Rectangle,
}

struct Goal {
    shape: Shape,
    position: DVec3,
    color: Rgb,
    bounds: Rectangle,
    is_achieved: bool,
}

/// The surface that a ray meets.
struct Sample {
    color: Rgb,
    surface: Surface,
}

/// The properties that distinguish surfaces: edges between different ones are smoothed.
#[derive(Clone, Copy)]
struct Surface {
    body: Option<u16>,
    /// Number of points of the light that reach the surface.
    n_lit: u8,
    /// The normal in steps of a half, so that the faces of a box differ and those of a cylinder mostly do not: a digit
    /// from 0 to 4 for each component.
    face: u8,
    /// A bit for each goal in front of the surface or around it on the table.
    goals: u32,
}

impl Surface {
    /// Returns a number that is the same for equal surfaces only.
    fn packed(self) -> u64 {
        let body = self.body.map_or(0, |body| 1 + u64::from(body));
        (body << 47)
            | (u64::from(self.n_lit) << 40)
            | (u64::from(self.face) << 32)
            | u64::from(self.goals)
    }
}

/// The part of the table on which a body may cast a shadow: the points near a segment.
struct ShadowBounds {
    body_idx: usize,
    from: DVec2,
    to: DVec2,
    radius_m: f64,
    /// The part of the picture that contains them.
    bounds: Rectangle,
}

impl ShadowBounds {
    fn contains(&self, place: DVec2) -> bool {
        let (axis, offset) = (self.to - self.from, place - self.from);
        let length_m2 = axis.length_squared();
        let share =
            if length_m2 > 0.0 { (offset.dot(axis) / length_m2).clamp(0.0, 1.0) } else { 0.0 };
        (offset - share * axis).length_squared() < self.radius_m * self.radius_m
    }
}

struct Painter {
    camera: Camera,
    bodies: Vec<Body>,
    /// For each body, the bodies other than the table whose shadows may fall on it.
    blockers: Vec<Vec<usize>>,
    shadows: Vec<ShadowBounds>,
    /// Directions towards points of the light, unit vectors.
    light_points: [DVec3; N_LIGHT_POINTS as usize],
    goals: Vec<Goal>,
    tiles: Tiles,
    table_z_m: f64,
    tolerance_m: f64,
}

impl Painter {
    fn new(scene: &Scene, achieved: &[bool], width: usize, height: usize) -> Self {
        let table_z_m = table_z_m(scene);
        let camera = Camera::fitted(&scene.arms, table_z_m, width, height);
        let body = |(shape, color): (Shape, Rgb)| {
            let (ends, radius_m) = shape.extent();
            Body { bounds: camera.bounds(ends, radius_m), shape, color }
        };
        let tolerance_m = f64::from(scene.goal_tolerance_m);
        let achieved = achieved.iter().copied().chain(std::iter::repeat(false));
        let goal = |((position, color), is_achieved): ((&[f32; 3], &Rgb), bool)| {
            let position = DVec3::from(position.map(f64::from));
            let shape = Shape::sphere(position, tolerance_m);
            let bounds = camera.bounds([position; 2], tolerance_m);
            Goal { bounds, shape, position, color: *color, is_achieved }
        };
        let colors = || ARM_COLORS.iter().cycle();
        let arms = scene.arms.iter().zip(colors()).flat_map(|(arm, color)| shapes_of(arm, *color));
        let of_objects = colors().take(scene.arms.len()).chain(std::iter::repeat(&PART_COLOR));
        let objects = scene.objects.iter().zip(of_objects);
        let objects = objects.map(|(object, color)| (Shape::cuboid(object), *color));
        let table = (Shape::cuboid(&scene.table), TABLE_COLOR);
        let bodies: Vec<Body> =
            std::iter::once(table).chain(arms).chain(objects).map(body).collect();
        let goals: Vec<Goal> = scene.goals.iter().zip(colors()).zip(achieved).map(goal).collect();
        let shadows = shadow_bounds(&bodies, &camera, table_z_m);
        let mut tiles = Tiles::new(width, height);
        tiles.add(bodies.iter().map(|body| &body.bounds), |tile| &mut tile.bodies);
        tiles.add(shadows.iter().map(|shadow| &shadow.bounds), |tile| &mut tile.shadows);
        tiles.add(goals.iter().map(|goal| &goal.bounds), |tile| &mut tile.goals);
        Self {
            shadows,
            light_points: light_points(),
            blockers: bodies.iter().map(|body| blockers_of(body, &bodies)).collect(),
            bodies,
            goals,
            tiles,
            camera,
            table_z_m,
            tolerance_m,
        }
    }

    /// Returns the mean colour of a pixel at the edge of a surface.
    fn smooth(&self, x: usize, y: usize) -> Rgb {
        let offset = |sample| (centre(sample)) / (centre(N_SAMPLES) - 0.5) - 0.5;
        let tile = self.tiles.at(x, y);
        let samples = pixels(N_SAMPLES, N_SAMPLES)
            .map(|(i, j)| self.sample(tile, centre(x) + offset(i), centre(y) + offset(j)).color);
        samples.sum::<Rgb>() / (centre(N_SAMPLES * N_SAMPLES) - 0.5)
    }

    /// Returns the colour at a place in `tile`, pixels from the upper left corner of the picture.
    fn sample(&self, tile: &Tile, x: f64, y: f64) -> Sample {
        let (origin, direction) = self.camera.ray(x, y);
        let hit = self.nearest(tile, (x, y), origin, direction);
        let depth_m = hit.as_ref().map_or(f64::INFINITY, |(_, hit)| hit.distance_m);
        let (mut color, mut surface) = match &hit {
            Some((idx, hit)) => {
                let point = origin + hit.distance_m * direction;
                self.shade(*idx, hit, (point, direction), &tile.shadows)
            }
            None => (BACKGROUND, Surface { body: None, n_lit: 0, face: 0, goals: 0 }),
        };
        let goals = tile.goals.iter().map(|idx| (*idx, &self.goals[*idx]));
        for (idx, goal) in goals.filter(|(_, it)| it.bounds.contains(x, y)) {
            let front = goal.shape.hit(origin, direction).filter(|it| it.distance_m < depth_m);
            if let Some(front) = front {
                let rim = 1.0 - front.normal.dot(direction).abs();
                let opacity =
                    GOAL_OPACITIES[usize::from(goal.is_achieved)] + 0.35 * rim * rim * rim;
                color = color.lerp(lit(goal.color, 1.12), opacity);
                surface.goals |= 1 << (idx % 32);
            }
        }
        Sample { color, surface }
    }

    /// Returns the first body that a ray through pixel (`x`, `y`) meets, and where.
    fn nearest(
        &self,
        tile: &Tile,
        (x, y): (f64, f64),
        origin: DVec3,
        direction: DVec3,
    ) -> Option<(usize, Hit)> {
        let bodies = tile.bodies.iter().map(|idx| (*idx, &self.bodies[*idx]));
        let candidates = bodies.filter(|(_, it)| it.bounds.contains(x, y));
        let hits =
            candidates.filter_map(|(idx, body)| Some((idx, body.shape.hit(origin, direction)?)));
        hits.min_by(|(_, a), (_, b)| a.distance_m.total_cmp(&b.distance_m))
    }

    /// Returns the colour of body `idx` at `point`, where `hit` is, seen along the unit vector `direction`. `shadows` are
    /// those that may fall on the table there.
    fn shade(
        &self,
        idx: usize,
        hit: &Hit,
        (point, direction): (DVec3, DVec3),
        shadows: &[usize],
    ) -> (Rgb, Surface) {
        let normal = hit.normal;
        let (facing, n_lit) = (normal.dot(LIGHT).max(0.0), self.n_lit(idx, hit, point, shadows));
        let brightness = 0.60 + 0.07 * normal.z + 0.46 * facing;
        let mut color = lit(self.bodies[idx].color, brightness);
        let mut goals = 0;
        if idx == TABLE && normal.z > 0.5 {
            for (goal_idx, goal) in self.goals.iter().enumerate() {
                let below = goal.position.with_z(self.table_z_m);
                let distance_m = point.distance(below) - self.tolerance_m;
                if distance_m.abs() < RING_HALF_WIDTH_M {
                    color = lit(goal.color, 0.85);
                    goals |= 1 << (goal_idx % 32);
                } else if distance_m < 0.0 {
                    color = color.lerp(goal.color, 0.14);
                }
            }
        }
        if facing > 0.0 {
            let share = f64::from(n_lit) / f64::from(N_LIGHT_POINTS);
            color *= SHADOW + (1.0 - SHADOW) * share;
            if idx != TABLE {
                let halfway = (LIGHT - direction).normalize();
                let highlight = normal.dot(halfway).max(0.0).powi(SHARPNESS);
                color = color.lerp(WHITE, HIGHLIGHT * share * highlight);
            }
        }
        (color, Surface { body: u16::try_from(idx).ok(), n_lit, face: face(normal), goals })
    }

    /// Returns how many points of the light reach the surface at `point`. Only shadows on the table have a soft edge.
    fn n_lit(&self, idx: usize, hit: &Hit, point: DVec3, shadows: &[usize]) -> u8 {
        if hit.normal.dot(LIGHT) <= 0.0 {
            return 0;
        }
        let start = point + SHADOW_OFFSET_M * hit.normal;
        if idx != TABLE || hit.normal.z < 0.5 {
            let is_blocked = |idx: &usize| self.bodies[*idx].shape.hit(start, LIGHT).is_some();
            return N_LIGHT_POINTS * u8::from(!self.blockers[idx].iter().any(is_blocked));
        }
        let place = point.truncate();
        let near = |it: &&ShadowBounds| it.contains(place);
        let mut is_free = [true; N_LIGHT_POINTS as usize];
        for bounds in shadows.iter().map(|idx| &self.shadows[*idx]).filter(near) {
            let shape = &self.bodies[bounds.body_idx].shape;
            for (is_free, light) in is_free.iter_mut().zip(self.light_points) {
                *is_free = *is_free && shape.hit(start, light).is_none();
            }
        }
        is_free.into_iter().map(u8::from).sum()
    }
}

/// Returns the parts of the table on which the bodies other than the table may cast shadows.
fn shadow_bounds(bodies: &[Body], camera: &Camera, table_z_m: f64) -> Vec<ShadowBounds> {
    let bounds = |(body_idx, body): (usize, &Body)| {
        let (ends, radius_m) = body.shape.extent();
        let distances_m = ends.map(|end| (end.z - table_z_m) / LIGHT.z);
        let soft_m = SOFT_WIDENING * LIGHT_RADIUS * distances_m[0].abs().max(distances_m[1].abs());
        let radius_m = (radius_m + soft_m) / LIGHT.z;
        let shadow = |idx: usize| ends[idx] - distances_m[idx] * LIGHT;
        let ends = [shadow(0), shadow(1)];
        let [from, to] = ends.map(DVec3::truncate);
        ShadowBounds { body_idx, from, to, radius_m, bounds: camera.bounds(ends, radius_m) }
    };
    bodies.iter().enumerate().skip(1).map(bounds).collect()
}

/// Returns the indices of the bodies other than the table whose shadows may fall on `body`.
fn blockers_of(body: &Body, bodies: &[Body]) -> Vec<usize> {
    let may_block = |other: &Body| {
        let offset = other.shape.centre - body.shape.centre;
        let along_m = offset.dot(LIGHT);
        let radius_m = body.shape.radius_m + other.shape.radius_m + BLOCKER_MARGIN_M;
        along_m >= -radius_m && (offset - along_m * LIGHT).length() <= radius_m
    };
    let others = bodies.iter().enumerate().skip(1);
    others.filter(|(_, other)| may_block(other)).map(|(idx, _)| idx).collect()
}

/// Returns directions towards points of the light: its centre, and a ring around it.
fn light_points() -> [DVec3; N_LIGHT_POINTS as usize] {
    let middle = LIGHT.normalize();
    let (u, v) = middle.any_orthonormal_pair();
    std::array::from_fn(|idx| match idx {
        0 => middle,
        _ => {
            let angle_rad =
                std::f64::consts::TAU * (centre(idx) - 0.5) / f64::from(N_LIGHT_POINTS - 1);
            (middle + LIGHT_RADIUS * (angle_rad.cos() * u + angle_rad.sin() * v)).normalize()
        }
    })
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a unit vector, so from 0 to 4"
)]
fn face(normal: DVec3) -> u8 {
    (2.0 * normal + 2.5).to_array().into_iter().fold(0, |face, digit| 5 * face + digit as u8)
}

/// Changes the brightness of a colour: 0 is black, 1 the colour itself, 2 white.
fn lit(color: Rgb, brightness: f64) -> Rgb {
    if brightness <= 1.0 { color * brightness } else { color.lerp(WHITE, brightness - 1.0) }
}

/// Returns the parts of an arm.
fn shapes_of(arm: &ArmScene, color: Rgb) -> Vec<(Shape, Rgb)> {
    let [x, y, z] = arm.base;
    let pedestal = Cuboid {
        centre: [x, y, z + PEDESTAL_HALF_M[2]],
        orientation: [0.0, 0.0, 0.0, 1.0],
        half_extents_m: PEDESTAL_HALF_M,
    };
    let post = arm.links.first().map(|link| Capsule { from: arm.base, to: link.from, ..*link });
    let links: Vec<Capsule> = post.into_iter().chain(arm.links.iter().copied()).collect();
    let joints = links.windows(2).filter_map(|pair| {
        let [link, next] = pair else { return None };
        let radius_m = JOINT_WIDENING * f64::from(link.radius_m.max(next.radius_m));
        Some((Shape::sphere(DVec3::from(link.to.map(f64::from)), radius_m), color))
    });
    let bars = links.iter().map(|link| (Shape::capsule(link), LINK_COLOR.lerp(color, LINK_TINT)));
    let hand = arm.hand.iter().map(|part| (Shape::cuboid(part), HAND_COLOR));
    let pedestal = std::iter::once((Shape::cuboid(&pedestal), PEDESTAL_COLOR));
    pedestal.chain(bars).chain(joints).chain(hand).collect()
}

#[cfg(all(test, feature = "files"))]
mod tests {
    use super::*;

    impl Painter {
        /// Draws as if everything could be seen everywhere.
        fn without_bounds(mut self) -> (Self, Tile) {
            let n_bodies = self.bodies.len();
            let everywhere = || Rectangle { low: [f64::MIN; 2], high: [f64::MAX; 2] };
            self.bodies.iter_mut().for_each(|body| body.bounds = everywhere());
            self.goals.iter_mut().for_each(|goal| goal.bounds = everywhere());
            self.shadows.iter_mut().for_each(|shadow| shadow.radius_m = f64::INFINITY);
            self.blockers = vec![(1..n_bodies).collect(); n_bodies];
            let tile = Tile {
                bodies: (0..n_bodies).collect(),
                shadows: (0..self.shadows.len()).collect(),
                goals: (0..self.goals.len()).collect(),
            };
            (self, tile)
        }
    }

    #[test]
    fn tiles_and_bounds_leave_out_nothing_that_can_be_seen() {
        for (scene, (width, height)) in [
            (crate::tests::scene(0.0, -0.2), (200, 130)),
            (crate::tests::scene(0.0, 0.3), (97, 65)),
        ] {
            let painter = || Painter::new(&scene, &[true], width, height);
            let (bounded, (all, tile)) = (painter(), painter().without_bounds());
            for (x, y) in pixels(width, height) {
                let sample = bounded.sample(bounded.tiles.at(x, y), centre(x), centre(y));
                let expected = all.sample(&tile, centre(x), centre(y));
                assert_eq!(sample.color, expected.color, "({x}, {y})");
                assert_eq!(sample.surface.packed(), expected.surface.packed(), "({x}, {y})");
            }
        }
    }
}
