//! A picture of the scene as SVG: table, arms, objects and goals in perspective, far things first.

mod camera;
mod color;
mod paint;

use tandem_core::layout::GOAL_TOLERANCE_M;
use tandem_core::scene::{ArmScene, Capsule, Point, Scene};

use camera::{Camera, Vec3};
use color::Rgb;
use paint::Painter;

/// From where the scene is seen and how large the picture is.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Direction from which one looks, about the vertical, degrees: 0 looks along +y, from the table's long side.
    pub azimuth_deg: f64,
    /// How far above the horizontal one stands, degrees, in (0, 90).
    pub elevation_deg: f64,
    /// Distance from the middle of the scene, metres: the nearer, the stronger the perspective.
    pub distance_m: f64,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// A line of text in the upper left corner.
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

/// One colour for each arm and what belongs to it; a further arm starts again.
const ARM_COLORS: [Rgb; 3] = [Rgb(0x2f, 0x78, 0xbd), Rgb(0xe0, 0x80, 0x33), Rgb(0x3c, 0x9a, 0x66)];
const TABLE_COLOR: Rgb = Rgb(0xe9, 0xe4, 0xdb);
const LINK_COLOR: Rgb = Rgb(0xee, 0xf0, 0xf3);
const HAND_COLOR: Rgb = Rgb(0x4a, 0x52, 0x5c);
const PEDESTAL_COLOR: Rgb = Rgb(0x59, 0x61, 0x6b);
/// Height above its base that an arm may need in the picture, metres.
const ARM_HEIGHT_M: f64 = 0.75;
/// How far ahead of its base an arm's workspace ends, and half its width, metres.
const REACH_M: f64 = 0.62;
const HALF_WORKSPACE_M: f64 = 0.36;
/// Room beside a base, metres.
const STANDING_ROOM_M: f64 = 0.16;
const PEDESTAL_RADIUS_M: f64 = 0.075;
const PEDESTAL_HEIGHT_M: f32 = 0.035;
/// How much wider than its links a joint is drawn.
const JOINT_WIDENING: f64 = 1.12;

/// The colour of an arm and of what belongs to it, as SVG writes it; darker below a `brightness` of 1, lighter above.
pub(crate) fn arm_color(arm: usize, brightness: f64) -> String {
    ARM_COLORS[arm % ARM_COLORS.len()].lit(brightness).hex()
}

/// Draws `scene` as seen by `view`.
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
        painter.goal(goal.map(f64::from), f64::from(GOAL_TOLERANCE_M), *color);
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

/// The links, and first the post on which they stand when they begin above the base.
fn links_from_base(arm: &ArmScene) -> Vec<Capsule> {
    let post = arm.links.first().filter(|link| link.from != arm.base);
    let post = post.map(|link| Capsule { from: arm.base, to: link.from, radius_m: link.radius_m });
    post.into_iter().chain(arm.links.iter().copied()).collect()
}

/// What must be in the picture: where the arms stand, what they reach, and how high they rise. It does not move with
/// the arms, so that pictures of one episode match.
fn framed_points(scene: &Scene) -> Vec<Vec3> {
    let table_z_m = table_height_m(scene);
    let around = |arm: &ArmScene| {
        let [x, y, z] = arm.base.map(f64::from);
        let ahead_m = if x < 0.0 { REACH_M } else { -REACH_M };
        let beside = |x_m: f64, side_m: f64| [x_m, y + side_m, table_z_m];
        [
            [x, y, z + ARM_HEIGHT_M],
            beside(x, -STANDING_ROOM_M),
            beside(x, STANDING_ROOM_M),
            beside(x + ahead_m, -HALF_WORKSPACE_M),
            beside(x + ahead_m, HALF_WORKSPACE_M),
        ]
    };
    let arms = scene.arms.iter().flat_map(around);
    arms.chain(scene.goals.iter().map(|goal| goal.map(f64::from)))
        .chain([[0.0, 0.0, table_z_m]])
        .collect()
}

/// `link`, its round end raised when it would stick out below the pedestal.
fn on_pedestal(link: &Capsule, base: Point) -> Capsule {
    let lowest_m = base[2] + PEDESTAL_HEIGHT_M + 0.6 * link.radius_m;
    let [x, y, z] = link.from;
    Capsule { from: [x, y, z.max(lowest_m).min(link.to[2].max(z))], ..*link }
}

fn table_height_m(scene: &Scene) -> f64 {
    f64::from(scene.table.centre[2] + scene.table.half_extents_m[2])
}
