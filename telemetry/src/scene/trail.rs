//! The paths of the tools, planned and measured, as lines.

use foxglove::messages::{
    Color, LinePrimitive, Point3, Pose, SceneEntity, SpherePrimitive, Timestamp, Vector3,
    line_primitive::Type,
};

use super::{NO_ROTATION, WORLD, color_of};

/// Minimum distance between the points of a line, metres.
const SPACING_M: f64 = 0.005;
/// Maximum number of points of a line. Every snapshot repeats them, so the points of a longer path are further apart.
const MAX_POINTS: usize = 256;
const PLANNED_TOOL_RADIUS_M: f64 = 0.012;
const PLANNED_TOOL_ALPHA: f64 = 0.4;

/// Style of a kind of line.
struct LineStyle {
    name: &'static str,
    thickness_px: f64,
    alpha: f64,
}

const PLANNED: LineStyle = LineStyle { name: "planned", thickness_px: 1.5, alpha: 0.55 };
const MEASURED: LineStyle = LineStyle { name: "measured", thickness_px: 4.0, alpha: 1.0 };

/// Paths of the tools so far, in arm order.
pub(crate) struct Trails {
    planned: Vec<Trail>,
    measured: Vec<Trail>,
}

impl Trails {
    pub(crate) fn new(n_arms: usize) -> Self {
        let empty = || (0..n_arms).map(|_| Trail::default()).collect();
        Self { planned: empty(), measured: empty() }
    }

    /// Extends the paths to the present positions of the tools (world, metres).
    ///
    /// The path of an arm that a slice does not contain stays as it is.
    pub(crate) fn extend(&mut self, planned: &[[f64; 3]], measured: &[[f64; 3]]) {
        for (trails, tools) in [(&mut self.planned, planned), (&mut self.measured, measured)] {
            for (trail, tool) in trails.iter_mut().zip(tools) {
                trail.extend(*tool);
            }
        }
    }

    /// Returns the lines `planned{i}`, thin and pale, and `measured{i}`, thick, and a sphere at the planned position of
    /// each tool.
    pub(crate) fn entities(&self, planned: &[[f64; 3]], stamp: Timestamp) -> Vec<SceneEntity> {
        let lines = [(&self.planned, PLANNED), (&self.measured, MEASURED)];
        let mut entities: Vec<SceneEntity> = lines
            .into_iter()
            .flat_map(|(trails, style)| {
                let trails = trails.iter().enumerate();
                trails.map(move |(i, trail)| SceneEntity {
                    lines: vec![trail.line(&style, i)],
                    ..entity(format!("{}{i}", style.name), stamp)
                })
            })
            .collect();
        for (i, entity) in entities.iter_mut().take(self.planned.len()).enumerate() {
            entity.spheres = planned.get(i).map(|tool| sphere(*tool, i)).into_iter().collect();
        }
        entities
    }
}

/// The path of one tool.
#[derive(Default)]
struct Trail {
    /// At least [`SPACING_M`] times a power of two apart.
    points: Vec<[f64; 3]>,
    last: Option<[f64; 3]>,
    /// Number of times that every other point was removed.
    n_halved: u32,
}

impl Trail {
    fn extend(&mut self, tool: [f64; 3]) {
        self.last = Some(tool);
        let spacing_m = SPACING_M * f64::from(1_u32 << self.n_halved.min(20));
        let is_near = |point: &[f64; 3]| distance_m(point, &tool) < spacing_m;
        if self.points.last().is_some_and(is_near) {
            return;
        }
        self.points.push(tool);
        if self.points.len() > MAX_POINTS {
            let mut keep = false;
            self.points.retain(|_| {
                keep = !keep;
                keep
            });
            self.n_halved += 1;
        }
    }

    /// Returns the points and the present position as a line.
    fn line(&self, style: &LineStyle, arm: usize) -> LinePrimitive {
        let point = |[x, y, z]: [f64; 3]| Point3 { x, y, z };
        LinePrimitive {
            r#type: Type::LineStrip.into(),
            pose: Some(Pose {
                position: Some(Vector3 { x: 0.0, y: 0.0, z: 0.0 }),
                orientation: Some(NO_ROTATION),
            }),
            thickness: style.thickness_px,
            scale_invariant: true,
            points: self.points.iter().copied().chain(self.last).map(point).collect(),
            color: Some(Color { a: style.alpha, ..color_of(arm) }),
            ..LinePrimitive::default()
        }
    }
}

fn sphere(centre: [f64; 3], arm: usize) -> SpherePrimitive {
    let [x, y, z] = centre;
    let diameter_m = 2.0 * PLANNED_TOOL_RADIUS_M;
    SpherePrimitive {
        pose: Some(Pose { position: Some(Vector3 { x, y, z }), orientation: Some(NO_ROTATION) }),
        size: Some(Vector3 { x: diameter_m, y: diameter_m, z: diameter_m }),
        color: Some(Color { a: PLANNED_TOOL_ALPHA, ..color_of(arm) }),
    }
}

fn entity(id: String, stamp: Timestamp) -> SceneEntity {
    SceneEntity { timestamp: Some(stamp), frame_id: WORLD.to_owned(), id, ..Default::default() }
}

fn distance_m(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_any_length_has_few_points_and_ends_at_the_tool() {
        let mut trail = Trail::default();
        for step in 0..100_000_u32 {
            trail.extend([f64::from(step) * 1e-4, 0.0, 0.0]);
            assert!(trail.points.len() <= MAX_POINTS);
        }
        let line = trail.line(&MEASURED, 0);
        let xs: Vec<f64> = line.points.iter().map(|point| point.x).collect();
        assert!(xs.len() > MAX_POINTS / 3 && xs[0] == 0.0, "{}", xs.len());
        assert!((xs[xs.len() - 1] - 9.9999).abs() < 1e-9);
        let widest_m = xs.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max);
        assert!(widest_m < 0.17, "{widest_m}");
    }

    #[test]
    fn an_arm_at_rest_adds_no_points() {
        let mut trails = Trails::new(2);
        for _ in 0..50 {
            trails.extend(&[], &[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]);
        }
        let n_points = |id: &str| {
            let entities = trails.entities(&[], Timestamp::new(0, 0));
            let entity = entities.iter().find(|entity| entity.id == id).unwrap();
            entity.lines[0].points.len()
        };
        assert_eq!(["planned0", "planned1", "measured0", "measured1"].map(n_points), [0, 0, 2, 2]);
    }
}
