//! The part of the world that a trial's plot shows, and its projection onto the plot.

use tandem_telemetry::TrialRow;

use super::marker::{Marker, hex};
use crate::color::arm_color;
use crate::curve::{FAINT_INK, GRID, INK};

pub(super) const MARGIN_PX: f64 = 20.0;
/// Gap between the views, pixels.
const GAP_PX: f64 = 34.0;
/// Maximum height of views side by side, and of stacked views together, pixels.
const MAX_HEIGHT_PX: f64 = 460.0;
const MAX_STACK_PX: f64 = 580.0;
/// Views are stacked if that increases their scale by more than this factor.
const WORTH_STACKING: f64 = 1.2;
/// Padding around the content, metres.
const PADDING_M: f64 = 0.025;
/// An object that ends within this of everything else is shown where it is, metres.
const NEAR_M: f64 = 0.25;
/// Smallest extent that is shown, metres.
const MIN_EXTENT_M: f64 = 0.12;
const GRID_M: f64 = 0.1;
/// Lines of the grid that are drawn at most in one direction.
const MAX_GRID_LINES: u32 = 60;

/// The part of the world that is shown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bounds {
    low: [f64; 3],
    high: [f64; 3],
}

impl Bounds {
    /// Returns the bounds of all paths, starts and goals, the table, and final object positions that are near these.
    pub(super) fn of(row: &TrialRow) -> Self {
        let tolerance_m = row.goal_tolerance_m().unwrap_or(0.0);
        let tools = row.path.iter().flat_map(|point| point.planned.iter().chain(&point.measured));
        let mut points: Vec<[f64; 3]> = tools.chain(&row.starts).copied().collect();
        for goal in &row.goals {
            points.push(goal.map(|x| x - tolerance_m));
            points.push(goal.map(|x| x + tolerance_m));
        }
        let mut bounds = Self::around(&points);
        let near =
            Self { low: bounds.low.map(|x| x - NEAR_M), high: bounds.high.map(|x| x + NEAR_M) };
        points.extend(row.ends.iter().filter(|end| near.contains(end)));
        bounds = Self::around(&points);
        bounds.low[2] = bounds.low[2].min(0.0);
        for axis in 0..3 {
            let missing_m = (MIN_EXTENT_M - (bounds.high[axis] - bounds.low[axis])).max(0.0);
            bounds.low[axis] -= PADDING_M + 0.5 * missing_m;
            bounds.high[axis] += PADDING_M + 0.5 * missing_m;
        }
        bounds
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

    /// Lays out the views from above and from the side below `top_px`, in one scale, in a plot of `width_px`.
    ///
    /// Returns the two projections and the bottom edge of the lower one, pixels.
    pub(super) fn projections(&self, width_px: f64, top_px: f64) -> ([Projection; 2], f64) {
        let [dx, dy, dz] = std::array::from_fn(|axis| self.high[axis] - self.low[axis]);
        let width_px = width_px - 2.0 * MARGIN_PX;
        let beside = (0.5 * (width_px - GAP_PX) / dx).min(MAX_HEIGHT_PX / dy.max(dz));
        let stacked = (width_px / dx).min((MAX_STACK_PX - GAP_PX) / (dy + dz));
        let view = |axes, left_px, top_px, scale| Projection {
            axes,
            left_px,
            top_px,
            scale,
            bounds: *self,
        };
        if stacked > WORTH_STACKING * beside {
            let below_px = top_px + dy * stacked + GAP_PX;
            let above = view([0, 1], MARGIN_PX, top_px, stacked);
            let side = view([0, 2], MARGIN_PX, below_px, stacked);
            return ([above, side], below_px + dz * stacked);
        }
        let above = view([0, 1], MARGIN_PX, top_px, beside);
        let side = view([0, 2], MARGIN_PX + dx * beside + GAP_PX, top_px, beside);
        ([above, side], top_px + dy.max(dz) * beside)
    }
}

/// One view: a parallel projection onto two axes of the world, one to the right and one up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Projection {
    axes: [usize; 2],
    left_px: f64,
    top_px: f64,
    /// Pixels per metre.
    scale: f64,
    bounds: Bounds,
}

impl Projection {
    /// Projects a point (world, metres) onto the plot, pixels. Points outside the bounds are moved to the edge.
    pub(super) fn point_px(&self, point: [f64; 3]) -> (f64, f64) {
        let [right, up] = self.axes.map(|axis| {
            point[axis].clamp(self.bounds.low[axis], self.bounds.high[axis]) - self.bounds.low[axis]
        });
        let [_, height_px] = self.size_px();
        (self.left_px + right * self.scale, self.top_px + height_px - up * self.scale)
    }

    fn size_px(&self) -> [f64; 2] {
        self.axes.map(|axis| (self.bounds.high[axis] - self.bounds.low[axis]) * self.scale)
    }

    /// Draws the background with its grid and its `name`, and the table in the view from the side.
    pub(super) fn background(&self, name: &str) -> String {
        let [width_px, height_px] = self.size_px();
        let (left, top, grid) = (self.left_px, self.top_px, hex(GRID));
        let (right, bottom) = (left + width_px, top + height_px);
        let mut svg = format!(
            r##"<text x="{left:.1}" y="{:.1}" font-size="12" fill="{}">{name}</text><rect x="{left:.1}" y="{top:.1}" width="{width_px:.1}" height="{height_px:.1}" fill="#fbfcfd" stroke="{grid}"/>"##,
            top - 7.0,
            hex(FAINT_INK),
        );
        for value in self.grid(0) {
            let x = left + (value - self.bounds.low[self.axes[0]]) * self.scale;
            svg.push_str(&line([x, top], [x, bottom], &grid, 1.0));
        }
        for value in self.grid(1) {
            let y = bottom - (value - self.bounds.low[self.axes[1]]) * self.scale;
            svg.push_str(&line([left, y], [right, y], &grid, 1.0));
        }
        if self.axes[1] == 2 {
            let (_, y) = self.point_px([0.0; 3]);
            svg.push_str(&line([left, y], [right, y], "#b9ab94", 2.0));
        }
        svg
    }

    /// Returns the coordinates of the grid lines along an axis.
    fn grid(&self, axis: usize) -> Vec<f64> {
        let axis = self.axes[axis];
        let first = (self.bounds.low[axis] / GRID_M).ceil();
        (0..MAX_GRID_LINES)
            .map(|idx| GRID_M * (first + f64::from(idx)))
            .take_while(|value| *value < self.bounds.high[axis])
            .collect()
    }

    /// Draws a scale bar of 10 cm, `y` pixels from the top.
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

    /// Draws a goal and its tolerance, metres.
    pub(super) fn goal(&self, goal: [f64; 3], tolerance_m: f64, arm: usize) -> String {
        let (x, y) = self.point_px(goal);
        let radius = tolerance_m * self.scale;
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

    /// Draws the start and, if it is known, the end of an object.
    pub(super) fn object(&self, start: [f64; 3], end: Option<[f64; 3]>, arm: usize) -> String {
        let (x, y) = self.point_px(start);
        let start_marker = Marker::ObjectStart.svg(arm, x, y);
        let Some((to_x, to_y)) = end.map(|end| self.point_px(end)) else { return start_marker };
        format!(
            r#"<line x1="{x:.1}" y1="{y:.1}" x2="{to_x:.1}" y2="{to_y:.1}" stroke="{}" stroke-width="1.2" stroke-dasharray="1 3"/>{start_marker}{}"#,
            arm_color(arm, 0.8),
            Marker::ObjectEnd.svg(arm, to_x, to_y)
        )
    }

    /// Draws the path of a tool. An empty path gives an empty string.
    pub(super) fn path(&self, path: &[[f64; 3]], arm: usize, style: Marker) -> String {
        if path.is_empty() {
            return String::new();
        }
        let points: Vec<String> = path
            .iter()
            .map(|point| self.point_px(*point))
            .map(|(x, y)| format!("{x:.1},{y:.1}"))
            .collect();
        format!(
            r#"<polyline points="{}" fill="none" stroke-linejoin="round" {}/>"#,
            points.join(" "),
            style.stroke(arm)
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

    fn bounds(extent_m: [f64; 3]) -> Bounds {
        Bounds { low: [0.0; 3], high: extent_m }
    }

    #[test]
    fn both_views_fit_and_have_one_scale_on_all_axes() {
        for extent_m in [[0.6, 0.6, 0.4], [1.2, 0.3, 0.3], [0.2, 0.9, 0.2], [0.3, 0.2, 1.5]] {
            for width_px in [760.0, 360.0] {
                let ([above, side], bottom_px) = bounds(extent_m).projections(width_px, 100.0);
                assert_eq!(above.scale, side.scale);
                for view in [above, side] {
                    let low = view.point_px([0.0; 3]);
                    let high = view.point_px(extent_m);
                    let [right, up] = view.axes.map(|axis| extent_m[axis] * view.scale);
                    assert!(
                        (high.0 - low.0 - right).abs() < 1e-9 && (low.1 - high.1 - up).abs() < 1e-9
                    );
                    assert!(low.0 >= MARGIN_PX - 1e-9 && high.0 <= width_px - MARGIN_PX + 1e-9);
                    assert!(high.1 >= 100.0 - 1e-9 && low.1 <= bottom_px + 1e-9);
                }
            }
        }
    }

    #[test]
    fn a_point_outside_the_bounds_is_drawn_at_the_edge() {
        let ([above, _], _) = bounds([0.4, 0.4, 0.4]).projections(760.0, 100.0);
        assert_eq!(above.point_px([9.0, 0.2, 0.0]), above.point_px([0.4, 0.2, 0.0]));
        assert_eq!(above.point_px([0.1, -5.0, 0.0]), above.point_px([0.1, 0.0, 0.0]));
    }
}
