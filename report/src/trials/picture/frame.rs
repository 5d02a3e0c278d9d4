//! Which part of the world is shown, and where on the picture.

use tandem_core::layout::GOAL_TOLERANCE_M;
use tandem_telemetry::TrialRow;

use super::glyph::{Glyph, hex};
use crate::curve::{FAINT_INK, GRID, INK};
use crate::scene::arm_color;

pub(super) const WIDTH_PX: f64 = 760.0;
pub(super) const MARGIN_PX: f64 = 20.0;
/// Between two views.
const GAP_PX: f64 = 34.0;
/// Views beside each other are no higher, views above each other not together.
const MAX_HEIGHT_PX: f64 = 460.0;
const MAX_STACK_PX: f64 = 580.0;
/// Views stand above each other when that makes them so much larger.
const WORTH_STACKING: f64 = 1.2;
/// Room round what is shown, metres.
const ROOM_M: f64 = 0.025;
/// An object that ends within this of everything else is shown where it is, metres.
const NEAR_M: f64 = 0.25;
/// Smallest extent that is shown, metres.
const MIN_EXTENT_M: f64 = 0.12;
const GRID_M: f64 = 0.1;
/// Lines of the grid that are drawn at most in one direction.
const MAX_GRID_LINES: u32 = 60;

/// The part of the world that is shown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Frame {
    low: [f64; 3],
    high: [f64; 3],
}

impl Frame {
    /// Around all ways, starts and goals, the table, and objects that ended near enough.
    pub(super) fn of(row: &TrialRow) -> Self {
        let tolerance_m = f64::from(GOAL_TOLERANCE_M);
        let tools = row.path.iter().flat_map(|tools| tools.planned.iter().chain(&tools.measured));
        let mut points: Vec<[f64; 3]> = tools.chain(&row.starts).copied().collect();
        for goal in &row.goals {
            points.push(goal.map(|x| x - tolerance_m));
            points.push(goal.map(|x| x + tolerance_m));
        }
        let mut frame = Self::around(&points);
        let near =
            Self { low: frame.low.map(|x| x - NEAR_M), high: frame.high.map(|x| x + NEAR_M) };
        points.extend(row.ends.iter().filter(|end| near.contains(end)));
        frame = Self::around(&points);
        frame.low[2] = frame.low[2].min(0.0);
        for axis in 0..3 {
            let lacking_m = (MIN_EXTENT_M - (frame.high[axis] - frame.low[axis])).max(0.0);
            frame.low[axis] -= ROOM_M + 0.5 * lacking_m;
            frame.high[axis] += ROOM_M + 0.5 * lacking_m;
        }
        frame
    }

    fn around(points: &[[f64; 3]]) -> Self {
        let end = |axis: usize, pick: fn(f64, f64) -> f64| {
            points.iter().map(|point| point[axis]).reduce(pick).unwrap_or(0.0)
        };
        Self {
            low: std::array::from_fn(|axis| end(axis, f64::min)),
            high: std::array::from_fn(|axis| end(axis, f64::max)),
        }
    }

    fn contains(&self, point: &[f64; 3]) -> bool {
        (0..3).all(|axis| (self.low[axis]..=self.high[axis]).contains(&point[axis]))
    }

    /// The views from above and from the side below `top_px`, in one scale, and where the lower one ends.
    pub(super) fn planes(&self, top_px: f64) -> ([Plane; 2], f64) {
        let [dx, dy, dz] = std::array::from_fn(|axis| self.high[axis] - self.low[axis]);
        let width_px = WIDTH_PX - 2.0 * MARGIN_PX;
        let beside = (0.5 * (width_px - GAP_PX) / dx).min(MAX_HEIGHT_PX / dy.max(dz));
        let stacked = (width_px / dx).min((MAX_STACK_PX - GAP_PX) / (dy + dz));
        let plane =
            |axes, left_px, top_px, scale| Plane { axes, left_px, top_px, scale, frame: *self };
        if stacked > WORTH_STACKING * beside {
            let below_px = top_px + dy * stacked + GAP_PX;
            let above = plane([0, 1], MARGIN_PX, top_px, stacked);
            let side = plane([0, 2], MARGIN_PX, below_px, stacked);
            return ([above, side], below_px + dz * stacked);
        }
        let above = plane([0, 1], MARGIN_PX, top_px, beside);
        let side = plane([0, 2], MARGIN_PX + dx * beside + GAP_PX, top_px, beside);
        ([above, side], top_px + dy.max(dz) * beside)
    }
}

/// One view: two axes of the world, to the right and up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Plane {
    axes: [usize; 2],
    left_px: f64,
    top_px: f64,
    /// Pixels per metre.
    scale: f64,
    frame: Frame,
}

impl Plane {
    /// Where a place (world, metres) is on the picture, pixels; beyond the frame at its edge.
    pub(super) fn at(&self, place: [f64; 3]) -> (f64, f64) {
        let [right, up] = self.axes.map(|axis| {
            place[axis].clamp(self.frame.low[axis], self.frame.high[axis]) - self.frame.low[axis]
        });
        let [_, height_px] = self.size_px();
        (self.left_px + right * self.scale, self.top_px + height_px - up * self.scale)
    }

    fn size_px(&self) -> [f64; 2] {
        self.axes.map(|axis| (self.frame.high[axis] - self.frame.low[axis]) * self.scale)
    }

    /// The field with its grid and `name` above it, and the table where it is seen from the side.
    pub(super) fn background(&self, name: &str) -> String {
        let [width_px, height_px] = self.size_px();
        let (left, top, grid) = (self.left_px, self.top_px, hex(GRID));
        let (right, bottom) = (left + width_px, top + height_px);
        let mut drawn = format!(
            r##"<text x="{left:.1}" y="{:.1}" font-size="12" fill="{}">{name}</text><rect x="{left:.1}" y="{top:.1}" width="{width_px:.1}" height="{height_px:.1}" fill="#fbfcfd" stroke="{grid}"/>"##,
            top - 7.0,
            hex(FAINT_INK),
        );
        for value in self.grid(0) {
            let x = left + (value - self.frame.low[self.axes[0]]) * self.scale;
            drawn.push_str(&line([x, top], [x, bottom], &grid, 1.0));
        }
        for value in self.grid(1) {
            let y = bottom - (value - self.frame.low[self.axes[1]]) * self.scale;
            drawn.push_str(&line([left, y], [right, y], &grid, 1.0));
        }
        if self.axes[1] == 2 {
            let (_, y) = self.at([0.0; 3]);
            drawn.push_str(&line([left, y], [right, y], "#b9ab94", 2.0));
        }
        drawn
    }

    /// Multiples of the grid's width within the frame.
    fn grid(&self, axis: usize) -> Vec<f64> {
        let axis = self.axes[axis];
        let first = (self.frame.low[axis] / GRID_M).ceil();
        (0..MAX_GRID_LINES)
            .map(|idx| GRID_M * (first + f64::from(idx)))
            .take_while(|value| *value < self.frame.high[axis])
            .collect()
    }

    /// Ten centimetres at this scale, `y` pixels from the top.
    pub(super) fn scale_bar(&self, y: f64) -> String {
        let (left, right, ink) = (self.left_px, self.left_px + GRID_M * self.scale, hex(INK));
        let ends = [left, right].map(|x| line([x, y - 4.0], [x, y + 4.0], &ink, 1.5)).concat();
        let text = format!(
            r#"<text x="{:.1}" y="{:.1}" font-size="12" fill="{ink}">10 cm</text>"#,
            right + 8.0,
            y + 4.0
        );
        line([left, y], [right, y], &ink, 1.5) + &ends + &text
    }

    /// A goal and what is near enough to it.
    pub(super) fn goal(&self, goal: [f64; 3], arm: usize) -> String {
        let (x, y) = self.at(goal);
        let radius = f64::from(GOAL_TOLERANCE_M) * self.scale;
        let color = arm_color(arm, 1.0);
        let cross = [
            line([x - 4.0, y], [x + 4.0, y], &color, 1.0),
            line([x, y - 4.0], [x, y + 4.0], &color, 1.0),
        ];
        format!(
            r#"<circle cx="{x:.1}" cy="{y:.1}" r="{radius:.1}" fill="{color}" fill-opacity="0.13" stroke="{color}" stroke-width="1"/>{}"#,
            cross.concat()
        )
    }

    /// An object where it lay at first and, when that is known, where it ended.
    pub(super) fn object(&self, start: [f64; 3], end: Option<[f64; 3]>, arm: usize) -> String {
        let (x, y) = self.at(start);
        let first = Glyph::ObjectStart.of_arm(arm, x, y);
        let Some((to_x, to_y)) = end.map(|end| self.at(end)) else { return first };
        format!(
            r#"<line x1="{x:.1}" y1="{y:.1}" x2="{to_x:.1}" y2="{to_y:.1}" stroke="{}" stroke-width="1.2" stroke-dasharray="1 3"/>{first}{}"#,
            arm_color(arm, 0.8),
            Glyph::ObjectEnd.of_arm(arm, to_x, to_y)
        )
    }

    /// A tool's way as a line; nothing where there is none.
    pub(super) fn way(&self, way: &[[f64; 3]], arm: usize, kind: Glyph) -> String {
        if way.is_empty() {
            return String::new();
        }
        let points: Vec<String> = way
            .iter()
            .map(|place| self.at(*place))
            .map(|(x, y)| format!("{x:.1},{y:.1}"))
            .collect();
        format!(
            r#"<polyline points="{}" fill="none" stroke-linejoin="round" {}/>"#,
            points.join(" "),
            kind.stroke(arm)
        )
    }
}

fn line([x1, y1]: [f64; 2], [x2, y2]: [f64; 2], color: &str, width_px: f64) -> String {
    format!(
        r#"<line x1="{x1:.1}" y1="{y1:.1}" x2="{x2:.1}" y2="{y2:.1}" stroke="{color}" stroke-width="{width_px}"/>"#
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(extent_m: [f64; 3]) -> Frame {
        Frame { low: [0.0; 3], high: extent_m }
    }

    #[test]
    fn both_views_fit_and_have_one_scale_on_all_axes() {
        for extent_m in [[0.6, 0.6, 0.4], [1.2, 0.3, 0.3], [0.2, 0.9, 0.2], [0.3, 0.2, 1.5]] {
            let frame = frame(extent_m);
            let ([above, side], bottom_px) = frame.planes(100.0);
            assert_eq!(above.scale, side.scale);
            for plane in [above, side] {
                let low = plane.at([0.0; 3]);
                let high = plane.at(extent_m);
                let [right, up] = plane.axes.map(|axis| extent_m[axis] * plane.scale);
                assert!(
                    (high.0 - low.0 - right).abs() < 1e-9 && (low.1 - high.1 - up).abs() < 1e-9
                );
                assert!(low.0 >= MARGIN_PX - 1e-9 && high.0 <= WIDTH_PX - MARGIN_PX + 1e-9);
                assert!(high.1 >= 100.0 - 1e-9 && low.1 <= bottom_px + 1e-9);
            }
        }
    }

    #[test]
    fn what_is_beyond_the_frame_stands_at_its_edge() {
        let ([above, _], _) = frame([0.4, 0.4, 0.4]).planes(100.0);
        assert_eq!(above.at([9.0, 0.2, 0.0]), above.at([0.4, 0.2, 0.0]));
        assert_eq!(above.at([0.1, -5.0, 0.0]), above.at([0.1, 0.0, 0.0]));
    }
}
