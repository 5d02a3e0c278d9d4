//! Plot of one trial: the paths of the tools, planned and measured, and the objects, from above and from the side.

mod marker;
mod projection;

use tandem_telemetry::{ToolPathPoint, TrialRow};

use super::{outcome, succeeded};
use crate::curve::layout::{legend_entries, wrapped};
use crate::curve::{Drawing, FAINT_INK, FONT, INK, NARROW_PX};
use crate::html::escaped;
use crate::table::NONE;
use marker::{Marker, hex};
use projection::{Bounds, MARGIN_PX, Projection};

/// Width of a plot, pixels.
const WIDTH_PX: u32 = 760;
/// Height of a text line, pixels.
const LINE_PX: f64 = 20.0;
/// Height of a line of the title, pixels.
const TITLE_LINE_PX: f64 = 22.0;
/// Minimum distance between points of a path, metres: less than half a pixel.
const SPACING_M: f64 = 0.0005;

/// Draws a trial as SVG, 760 pixels wide.
///
/// Both views have the same scale. An object that ended far away is drawn at the edge; the header has its distance to
/// the goal.
#[must_use]
pub fn trial_svg(row: &TrialRow) -> String {
    svg_of_width(row, WIDTH_PX)
}

/// Draws a trial for wide and for narrow screens.
pub(super) fn trial_drawing(row: &TrialRow) -> Drawing {
    Drawing { wide: trial_svg(row), narrow: svg_of_width(row, NARROW_PX) }
}

fn svg_of_width(row: &TrialRow, width_px: u32) -> String {
    let header = Header::of(row, width_px);
    let top_px = header.bottom_px + 34.0;
    let (views, bottom_px) = Bounds::of(row).projections(f64::from(width_px), top_px);
    let mut content = header.svg;
    for (view, name) in views.iter().zip(["from above: x, y", "from the side: x, z"]) {
        content.push_str(&view.background(name));
        content.push_str(&draw_trial(row, view));
    }
    content.push_str(&views[0].scale_bar(bottom_px + 20.0));
    let height_px = bottom_px + 38.0;
    format!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" width="{width_px}" height="{height_px:.0}" viewBox="0 0 {width_px} {height_px:.0}" font-family="{FONT}"><rect width="{width_px}" height="{height_px:.0}" fill="#ffffff"/>{content}</svg>"##
    )
}

/// The part above the views: title, facts and legend.
#[derive(Default)]
struct Header {
    svg: String,
    bottom_px: f64,
    /// Width of the plot, pixels.
    width_px: u32,
}

impl Header {
    fn of(row: &TrialRow, width_px: u32) -> Self {
        let title = format!("{}, trial {}: {}", row.task, row.trial, outcome(row));
        let mut header = Self { bottom_px: 30.0, width_px, ..Self::default() };
        // Bold text is wider.
        for line in wrapped(&title, 18, header.room_px()) {
            header.svg.push_str(&format!(
                r#"<text x="{MARGIN_PX:.0}" y="{:.0}" font-size="17" font-weight="bold" fill="{}">{}</text>"#,
                header.bottom_px,
                hex(INK),
                escaped(&line)
            ));
            header.bottom_px += TITLE_LINE_PX;
        }
        header.bottom_px -= TITLE_LINE_PX;
        for fact in facts(row) {
            header.add_text(&fact, &hex(INK));
        }
        if let Some(detail) = &row.detail {
            header.add_text(detail, &hex(FAINT_INK));
        }
        header.add_legend(row);
        header
    }

    /// Returns the width of text lines, pixels.
    fn room_px(&self) -> i32 {
        i32::try_from(self.width_px).unwrap_or(i32::MAX) - 40
    }

    /// Adds `text`, wrapped.
    fn add_text(&mut self, text: &str, color: &str) {
        for line in wrapped(text, 13, self.room_px()) {
            self.bottom_px += LINE_PX;
            self.svg.push_str(&format!(
                r#"<text x="{MARGIN_PX:.0}" y="{:.0}" font-size="13" fill="{color}">{}</text>"#,
                self.bottom_px,
                escaped(&line)
            ));
        }
    }

    fn add_legend(&mut self, row: &TrialRow) {
        let markers = markers(row);
        let names: Vec<String> = markers.iter().map(|marker| marker.name()).collect();
        let entries = legend_entries(names.iter().map(String::as_str), self.width_px);
        let first_px = self.bottom_px + 1.4 * LINE_PX;
        for (marker, entry) in markers.iter().zip(entries) {
            let left = f64::from(entry.left);
            let top = first_px + f64::from(entry.line) * LINE_PX;
            self.svg.push_str(&marker.legend_svg(left + 9.0, top - 4.5));
            for (line, name) in (0_u32..).zip(&entry.name) {
                let y = top + f64::from(line) * LINE_PX;
                self.svg.push_str(&format!(
                    r#"<text x="{:.0}" y="{y:.0}" font-size="13" fill="{}">{name}</text>"#,
                    left + 22.0,
                    hex(INK)
                ));
                self.bottom_px = y;
            }
        }
    }
}

/// Returns all markers that the plot of `row` may contain.
fn markers(row: &TrialRow) -> Vec<Marker> {
    let arms = (0..n_arms(row)).map(Marker::Arm);
    let end = if succeeded(row) { Marker::End } else { Marker::Stopped };
    let others = [
        Marker::Planned,
        Marker::Measured,
        end,
        Marker::ObjectStart,
        Marker::ObjectEnd,
        Marker::Goal,
    ];
    arms.chain(others).collect()
}

/// Returns the text lines of the header: policy, mode, duration and distances to the goals.
fn facts(row: &TrialRow) -> Vec<String> {
    let mut trial = format!("{}, {}, seed {}", row.policy, row.mode, row.seed);
    trial.push_str(&format!(": {:.1} s, {} steps", row.duration_s, row.n_steps));
    if row.n_shortened > 0 {
        trial.push_str(&format!(", {} of them shortened", row.n_shortened));
    }
    let mut facts = vec![trial];
    if !row.goal_distances_m.is_empty() {
        let distances = millimetres(&row.goal_distances_m);
        let rehearsed = row.rehearsed_m.as_deref().map(millimetres);
        let rehearsed = rehearsed.map(|mm| format!(", in rehearsal {mm} mm"));
        facts.push(format!(
            "distances to the goals: {distances} mm{}",
            rehearsed.unwrap_or_default()
        ));
    }
    facts
}

/// Draws the trial in one view: goals and objects first, then measured paths, then planned paths.
fn draw_trial(row: &TrialRow, view: &Projection) -> String {
    let mut svg = String::new();
    let tolerance_m = row.goal_tolerance_m().unwrap_or(0.0);
    for (arm, goal) in row.goals.iter().enumerate() {
        svg.push_str(&view.goal(*goal, tolerance_m, arm));
    }
    for (arm, start) in row.starts.iter().enumerate() {
        svg.push_str(&view.object(*start, row.ends.get(arm).copied(), arm));
    }
    let end_marker = if succeeded(row) { Marker::End } else { Marker::Stopped };
    for arm in 0..n_arms(row) {
        let measured = tool_path(row, arm, |point| &point.measured);
        let planned = tool_path(row, arm, |point| &point.planned);
        svg.push_str(&view.path(&measured, arm, Marker::Measured));
        svg.push_str(&view.path(&planned, arm, Marker::Planned));
        if let Some(last) = measured.last() {
            let (x, y) = view.point_px(*last);
            svg.push_str(&end_marker.svg(arm, x, y));
        }
    }
    svg
}

/// Returns the path of one tool, thinned out, with its last point.
fn tool_path(
    row: &TrialRow,
    arm: usize,
    positions: impl Fn(&ToolPathPoint) -> &Vec<[f64; 3]>,
) -> Vec<[f64; 3]> {
    let mut path: Vec<[f64; 3]> = Vec::new();
    let mut last = None;
    for position in row.path.iter().filter_map(|point| positions(point).get(arm)) {
        last = Some(*position);
        if path.last().is_none_or(|previous| SPACING_M < distance_m(previous, position)) {
            path.push(*position);
        }
    }
    path.extend(last.filter(|last| path.last() != Some(last)));
    path
}

/// Formats lengths in millimetres, arm by arm.
pub(crate) fn millimetres(lengths_m: &[f64]) -> String {
    match lengths_m {
        [] => NONE.to_owned(),
        _ => lengths_m.iter().map(|m| format!("{:.0}", 1000.0 * m)).collect::<Vec<_>>().join(" / "),
    }
}

fn n_arms(row: &TrialRow) -> usize {
    let tools = row.path.iter().map(|tools| tools.measured.len().max(tools.planned.len()));
    tools.max().unwrap_or(0).max(row.starts.len())
}

fn distance_m(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}
