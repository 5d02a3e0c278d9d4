//! A picture of a scene as SVG: table, arms, objects and goals in perspective.

mod camera;
mod color;
mod paint;

use tandem_core::scene::{ArmScene, Capsule, Point, Scene};

use camera::{Camera, Vec3};
use color::Rgb;
use paint::Painter;

/// Camera position and size of a picture.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Azimuth of the view, degrees: 0 looks along +y, from the long side of the table.
    pub azimuth_deg: f64,
    /// Elevation of the camera above the horizontal, degrees, in (0, 90).
    pub elevation_deg: f64,
    /// Distance of the camera from the centre of the scene, metres.
    pub distance_m: f64,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Text in the upper left corner.
    pub caption: Option<String>,
}

impl Default for View {
    fn default() -> Self {
        Self {
            azimuth_deg: -24.0,
            elevation_deg: 27.0,
            distance_m: 2.6,
            width: 900,
            height: 520,
            caption: None,
        }
    }
}

/// Colours of the arms and of their objects and goals; further arms reuse them.
const ARM_COLORS: [Rgb; 3] = [Rgb(0x2f, 0x78, 0xbd), Rgb(0xe0, 0x80, 0x33), Rgb(0x3c, 0x9a, 0x66)];
const TABLE_COLOR: Rgb = Rgb(0xe9, 0xe4, 0xdb);
const LINK_COLOR: Rgb = Rgb(0xee, 0xf0, 0xf3);
const HAND_COLOR: Rgb = Rgb(0x4a, 0x52, 0x5c);
const PEDESTAL_COLOR: Rgb = Rgb(0x59, 0x61, 0x6b);
/// Height above the base of an arm that the picture includes, metres.
const ARM_HEIGHT_M: f64 = 0.75;
/// Depth and half width of an arm's workspace that the picture includes, metres.
const REACH_M: f64 = 0.62;
const HALF_WORKSPACE_M: f64 = 0.36;
/// Margin beside a base, metres.
const BASE_MARGIN_M: f64 = 0.16;
const PEDESTAL_RADIUS_M: f64 = 0.075;
const PEDESTAL_HEIGHT_M: f32 = 0.035;
/// Ratio of the radius of a joint to that of its links.
const JOINT_WIDENING: f64 = 1.12;

/// Returns the colour of an arm for SVG; darker for a `brightness` below 1, lighter above 1.
pub(crate) fn arm_color(arm: usize, brightness: f64) -> String {
    ARM_COLORS[arm % ARM_COLORS.len()].lit(brightness).hex()
}

/// Draws `scene` as seen from `view`, as SVG.
#[must_use]
pub fn scene_svg(scene: &Scene, view: &View) -> String {
    let camera = Camera::fitted(view, &framed_points(scene));
    let mut painter = Painter::new(camera, table_height_m(scene));
    painter.table(&scene.table, TABLE_COLOR);
    for (arm, color) in scene.arms.iter().zip(ARM_COLORS.iter().cycle()) {
        draw_arm(&mut painter, arm, *color);
    }
    for (object, color) in scene.objects.iter().zip(ARM_COLORS.iter().cycle()) {
        painter.shadow_of_cuboid(object);
        painter.cuboid(object, *color);
    }
    for (goal, color) in scene.goals.iter().zip(ARM_COLORS.iter().cycle()) {
        painter.goal(goal.map(f64::from), f64::from(scene.goal_tolerance_m), *color);
    }
    painter.finish(view)
}

fn draw_arm(painter: &mut Painter, arm: &ArmScene, color: Rgb) {
    painter.pedestal(
        arm.base.map(f64::from),
        PEDESTAL_RADIUS_M,
        f64::from(PEDESTAL_HEIGHT_M),
        PEDESTAL_COLOR,
    );
    for link in links_from_base(arm) {
        painter.shadow_of_capsule(&link);
        painter.capsule(&on_pedestal(&link, arm.base), LINK_COLOR);
    }
    for pair in links_from_base(arm).windows(2) {
        if let [link, next] = pair {
            painter.joint(link, next, JOINT_WIDENING, color);
        }
    }
    for part in &arm.hand {
        painter.shadow_of_cuboid(part);
        painter.cuboid(part, HAND_COLOR);
    }
}

/// Returns the links of an arm, preceded by a post if they start above the base.
fn links_from_base(arm: &ArmScene) -> Vec<Capsule> {
    let post = arm.links.first().filter(|link| link.from != arm.base);
    let post = post.map(|link| Capsule { from: arm.base, to: link.from, radius_m: link.radius_m });
    post.into_iter().chain(arm.links.iter().copied()).collect()
}

/// Returns points that the picture includes: the bases, workspaces and heights of the arms, and the goals.
///
/// They do not depend on the arms' joints, so that all pictures of an episode have the same view.
fn framed_points(scene: &Scene) -> Vec<Vec3> {
    let table_z_m = table_height_m(scene);
    let around = |arm: &ArmScene| {
        let [x, y, z] = arm.base.map(f64::from);
        let ahead_m = if x < 0.0 { REACH_M } else { -REACH_M };
        let beside = |x_m: f64, side_m: f64| [x_m, y + side_m, table_z_m];
        [
            [x, y, z + ARM_HEIGHT_M],
            beside(x, -BASE_MARGIN_M),
            beside(x, BASE_MARGIN_M),
            beside(x + ahead_m, -HALF_WORKSPACE_M),
            beside(x + ahead_m, HALF_WORKSPACE_M),
        ]
    };
    let arms = scene.arms.iter().flat_map(around);
    arms.chain(scene.goals.iter().map(|goal| goal.map(f64::from)))
        .chain([[0.0, 0.0, table_z_m]])
        .collect()
}

/// Returns `link` with its lower end raised if it would extend below the pedestal.
fn on_pedestal(link: &Capsule, base: Point) -> Capsule {
    let lowest_m = base[2] + PEDESTAL_HEIGHT_M + 0.6 * link.radius_m;
    let [x, y, z] = link.from;
    Capsule { from: [x, y, z.max(lowest_m).min(link.to[2].max(z))], ..*link }
}

fn table_height_m(scene: &Scene) -> f64 {
    f64::from(scene.table.centre[2] + scene.table.half_extents_m[2])
}
