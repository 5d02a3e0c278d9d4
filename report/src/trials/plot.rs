//! Plot of one trial: the paths of the tools, planned and measured, and the objects, from above and from the side.

mod marker;
mod projection;

use tandem_telemetry::{ToolPathPoint, TrialRow};

use super::{outcome, succeeded};
use crate::curve::{FAINT_INK, FONT, INK, estimated_width_px, legend_positions};
use crate::html::escaped;
use crate::table::NONE;
use marker::{Marker, hex};
use projection::{Bounds, MARGIN_PX, Projection, WIDTH_PX};

/// Height of a text line, pixels.
const LINE_PX: f64 = 20.0;
/// Minimum distance between points of a path, metres: less than half a pixel.
const SPACING_M: f64 = 0.0005;

/// Draws a trial as SVG, 760 pixels wide.
///
/// Both views have the same scale. An object that ended far away is drawn at the edge; the header has its distance to
/// the goal.
#[must_use]
pub fn trial_svg(row: &TrialRow) -> String {
    let header = Header::of(row);
    let (views, bottom_px) = Bounds::of(row).projections(header.bottom_px + 34.0);
    let mut content = header.svg;
    for (view, name) in views.iter().zip(["from above: x, y", "from the side: x, z"]) {
        content.push_str(&view.background(name));
        content.push_str(&draw_trial(row, view));
    }
    content.push_str(&views[0].scale_bar(bottom_px + 20.0));
    let height_px = bottom_px + 38.0;
    format!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH_PX:.0}" height="{height_px:.0}" viewBox="0 0 {WIDTH_PX:.0} {height_px:.0}" font-family="{FONT}"><rect width="{WIDTH_PX:.0}" height="{height_px:.0}" fill="#ffffff"/>{content}</svg>"##
    )
}

/// The part above the views: title, facts and legend.
#[derive(Default)]
struct Header {
    svg: String,
    bottom_px: f64,
}

impl Header {
    fn of(row: &TrialRow) -> Self {
        let title = format!("{}, trial {}: {}", row.task, row.trial, outcome(row));
        let svg = format!(
            r#"<text x="{MARGIN_PX:.0}" y="30" font-size="17" font-weight="bold" fill="{}">{}</text>"#,
            hex(INK),
            escaped(&title)
        );
        let mut header = Self { svg, bottom_px: 30.0 };
        for fact in facts(row) {
            header.add_text(&fact, &hex(INK));
        }
        if let Some(detail) = &row.detail {
            header.add_text(detail, &hex(FAINT_INK));
        }
        header.add_legend(row);
        header
    }

    /// Adds `text`, wrapped.
    fn add_text(&mut self, text: &str, color: &str) {
        for line in wrapped(text, 13) {
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
        let positions = legend_positions(names.iter().map(String::as_str), width());
        let first_px = self.bottom_px + 1.4 * LINE_PX;
        for ((marker, name), (left, line)) in markers.iter().zip(&names).zip(positions) {
            let y = first_px + f64::from(line) * LINE_PX;
            let left = f64::from(left);
            self.svg.push_str(&marker.legend_svg(left + 9.0, y - 4.5));
            self.svg.push_str(&format!(
                r#"<text x="{:.0}" y="{y:.0}" font-size="13" fill="{}">{name}</text>"#,
                left + 22.0,
                hex(INK)
            ));
            self.bottom_px = y;
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

/// Wraps `text` at the width of the plot. A word that is too long has a line of its own.
fn wrapped(text: &str, size_px: u32) -> Vec<String> {
    let room_px = i32::try_from(width()).unwrap_or(i32::MAX) - 40;
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if estimated_width_px(&format!("{line} {word}"), size_px) <= room_px => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a whole number of pixels"
)]
const fn width() -> u32 {
    WIDTH_PX as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_text_is_wrapped_without_losing_words() {
        let text = "word ".repeat(100);
        let lines = wrapped(&text, 13);
        assert!(lines.len() > 1);
        assert!(lines.iter().all(|line| estimated_width_px(line, 13) <= 720), "{lines:?}");
        assert_eq!(lines.join(" "), text.trim());
        assert_eq!(wrapped(&"x".repeat(500), 13).len(), 1);
        assert_eq!(wrapped("", 13), [""; 0]);
    }
}
