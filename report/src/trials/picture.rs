//! A picture of one trial: the tools' ways, planned and measured, and the objects, from above and from the side.

mod frame;
mod glyph;

use tandem_telemetry::{ToolsAt, TrialRow};

use super::page::millimetres;
use super::{succeeded, verdict};
use crate::curve::{FAINT_INK, FONT, INK, estimated_width_px, legend_places};
use crate::html::escaped;
use frame::{Frame, MARGIN_PX, Plane, WIDTH_PX};
use glyph::{Glyph, hex};

/// Height of a line of text, pixels.
const LINE_PX: f64 = 20.0;
/// Displacement of a tool after which its line has another point, metres: less than half a pixel.
const SPACING_M: f64 = 0.0005;

/// Draws the trial `row` at the width of a learning curve.
///
/// Lengths have one scale in both views. An object that ended far away stands at the edge; the text says how far it is
/// from its goal.
#[must_use]
pub fn trial_svg(row: &TrialRow) -> String {
    let mut head = Head::default();
    head.write(row);
    let frame = Frame::of(row);
    let (planes, bottom_px) = frame.planes(head.bottom_px + 34.0);
    let mut drawn = head.svg;
    for (plane, name) in planes.iter().zip(["from above: x, y", "from the side: x, z"]) {
        drawn.push_str(&plane.background(name));
        drawn.push_str(&view(row, plane));
    }
    drawn.push_str(&planes[0].scale_bar(bottom_px + 20.0));
    let height_px = bottom_px + 38.0;
    format!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH_PX:.0}" height="{height_px:.0}" viewBox="0 0 {WIDTH_PX:.0} {height_px:.0}" font-family="{FONT}"><rect width="{WIDTH_PX:.0}" height="{height_px:.0}" fill="#ffffff"/>{drawn}</svg>"##
    )
}

/// What stands above the views: what was tried, how it ended, what the signs mean.
#[derive(Default)]
struct Head {
    svg: String,
    bottom_px: f64,
}

impl Head {
    fn write(&mut self, row: &TrialRow) {
        self.bottom_px = 30.0;
        let title = format!("{}, trial {}: {}", row.task, row.trial, verdict(row));
        self.svg = format!(
            r#"<text x="{MARGIN_PX:.0}" y="30" font-size="17" font-weight="bold" fill="{}">{}</text>"#,
            hex(INK),
            escaped(&title)
        );
        for fact in facts(row) {
            self.lines(&fact, &hex(INK));
        }
        if let Some(detail) = &row.detail {
            self.lines(detail, &hex(FAINT_INK));
        }
        self.legend(row);
    }

    /// Adds `text` on as many lines as it takes.
    fn lines(&mut self, text: &str, color: &str) {
        for line in wrapped(text, 13) {
            self.bottom_px += LINE_PX;
            self.svg.push_str(&format!(
                r#"<text x="{MARGIN_PX:.0}" y="{:.0}" font-size="13" fill="{color}">{}</text>"#,
                self.bottom_px,
                escaped(&line)
            ));
        }
    }

    fn legend(&mut self, row: &TrialRow) {
        let glyphs = glyphs(row);
        let names: Vec<String> = glyphs.iter().map(|glyph| glyph.name()).collect();
        let places = legend_places(names.iter().map(String::as_str), width());
        let first_px = self.bottom_px + 1.4 * LINE_PX;
        for ((glyph, name), (left, line)) in glyphs.iter().zip(&names).zip(places) {
            let y = first_px + f64::from(line) * LINE_PX;
            let left = f64::from(left);
            self.svg.push_str(&glyph.at(left + 9.0, y - 4.5));
            self.svg.push_str(&format!(
                r#"<text x="{:.0}" y="{y:.0}" font-size="13" fill="{}">{name}</text>"#,
                left + 22.0,
                hex(INK)
            ));
            self.bottom_px = y;
        }
    }
}

/// Every sign that the picture of `row` may have.
fn glyphs(row: &TrialRow) -> Vec<Glyph> {
    let arms = (0..n_arms(row)).map(Glyph::Arm);
    let end = if succeeded(row) { Glyph::End } else { Glyph::Stopped };
    let others =
        [Glyph::Planned, Glyph::Measured, end, Glyph::ObjectStart, Glyph::ObjectEnd, Glyph::Goal];
    arms.chain(others).collect()
}

/// Who tried and how long it took, and how near the objects came.
fn facts(row: &TrialRow) -> Vec<String> {
    let mut who = format!("{}, {}, seed {}", row.subject, row.mode, row.seed);
    who.push_str(&format!(": {:.1} s, {} steps", row.duration_s, row.n_steps));
    if row.n_shortened > 0 {
        who.push_str(&format!(", {} of them shortened", row.n_shortened));
    }
    let mut facts = vec![who];
    if !row.goal_distances_m.is_empty() {
        let distances = millimetres(&row.goal_distances_m);
        let rehearsed = row.rehearsed_m.as_deref().map(millimetres);
        let rehearsed = rehearsed.map(|mm| format!(", in the training world {mm} mm"));
        facts.push(format!(
            "objects from their goals: {distances} mm{}",
            rehearsed.unwrap_or_default()
        ));
    }
    facts
}

/// One view: objects below the ways, what was planned above what was measured.
fn view(row: &TrialRow, plane: &Plane) -> String {
    let mut drawn = String::new();
    for (arm, goal) in row.goals.iter().enumerate() {
        drawn.push_str(&plane.goal(*goal, arm));
    }
    for (arm, start) in row.starts.iter().enumerate() {
        drawn.push_str(&plane.object(*start, row.ends.get(arm).copied(), arm));
    }
    let ends_well = succeeded(row);
    for arm in 0..n_arms(row) {
        let measured = way(row, arm, |tools| &tools.measured);
        let planned = way(row, arm, |tools| &tools.planned);
        drawn.push_str(&plane.way(&measured, arm, Glyph::Measured));
        drawn.push_str(&plane.way(&planned, arm, Glyph::Planned));
        if let Some(last) = measured.last() {
            let end = if ends_well { Glyph::End } else { Glyph::Stopped };
            let (x, y) = plane.at(*last);
            drawn.push_str(&end.of_arm(arm, x, y));
        }
    }
    drawn
}

/// The way of one tool: places that are apart, and the last one.
fn way(row: &TrialRow, arm: usize, of: impl Fn(&ToolsAt) -> &Vec<[f64; 3]>) -> Vec<[f64; 3]> {
    let mut way: Vec<[f64; 3]> = Vec::new();
    let mut last = None;
    for place in row.path.iter().filter_map(|tools| of(tools).get(arm)) {
        last = Some(*place);
        if way.last().is_none_or(|before| SPACING_M < distance_m(before, place)) {
            way.push(*place);
        }
    }
    way.extend(last.filter(|last| way.last() != Some(last)));
    way
}

fn n_arms(row: &TrialRow) -> usize {
    let tools = row.path.iter().map(|tools| tools.measured.len().max(tools.planned.len()));
    tools.max().unwrap_or(0).max(row.starts.len())
}

fn distance_m(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// `text` in lines that fit; a word that is too long for one stands alone.
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
    fn long_texts_are_wrapped_and_lose_no_word() {
        let text = "word ".repeat(100);
        let lines = wrapped(&text, 13);
        assert!(lines.len() > 1);
        assert!(lines.iter().all(|line| estimated_width_px(line, 13) <= 720), "{lines:?}");
        assert_eq!(lines.join(" "), text.trim());
        assert_eq!(wrapped(&"x".repeat(500), 13).len(), 1);
        assert_eq!(wrapped("", 13), [""; 0]);
    }
}
