//! The signs of a picture, in it and in its legend.

use plotters::prelude::RGBColor;

use crate::curve::INK;
use crate::scene::arm_color;

/// Dashes of what was planned.
const DASHES: &str = "5 3";

/// A sign and what it means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Glyph {
    /// The colour of an arm.
    Arm(usize),
    /// The way that a motion had for a tool.
    Planned,
    /// The way that a tool took.
    Measured,
    /// Where a tool was when a trial failed.
    Stopped,
    /// Where a tool was when a trial succeeded.
    End,
    /// Where an object lay at first.
    ObjectStart,
    /// Where an object ended.
    ObjectEnd,
    /// A goal, and what is near enough to it.
    Goal,
}

impl Glyph {
    /// Its name in the legend.
    pub(super) fn name(self) -> String {
        match self {
            Self::Arm(arm) => return format!("arm {arm}"),
            Self::Planned => "tool, planned",
            Self::Measured => "tool, measured",
            Self::Stopped => "tool, where it stopped",
            Self::End => "tool, at the end",
            Self::ObjectStart => "object, at first",
            Self::ObjectEnd => "object, at the end",
            Self::Goal => "goal, 5 cm round it",
        }
        .to_owned()
    }

    /// The sign in an arm's colour round (`x`, `y`), pixels.
    pub(super) fn of_arm(self, arm: usize, x: f64, y: f64) -> String {
        self.drawn(&arm_color(arm, 1.0), &arm_color(arm, 0.55), x, y)
    }

    /// The sign as the legend has it.
    pub(super) fn at(self, x: f64, y: f64) -> String {
        let ink = hex(INK);
        match self {
            Self::Arm(arm) => self.drawn(&arm_color(arm, 1.0), &ink, x, y),
            Self::Planned | Self::Measured => {
                let (from, to) = (x - 8.5, x + 6.5);
                let stroke = self.stroke_of(&ink, &ink);
                format!(r#"<line x1="{from:.1}" y1="{y:.1}" x2="{to:.1}" y2="{y:.1}" {stroke}/>"#)
            }
            _ => self.drawn(&ink, &ink, x, y),
        }
    }

    /// The attributes of an arm's line.
    pub(super) fn stroke(self, arm: usize) -> String {
        self.stroke_of(&arm_color(arm, 1.0), &arm_color(arm, 0.55))
    }

    /// What was planned is drawn upon what was measured: darker, thinner and with gaps, both are seen where they are one.
    fn stroke_of(self, color: &str, dark: &str) -> String {
        match self {
            Self::Planned => {
                format!(r#"stroke="{dark}" stroke-width="1.2" stroke-dasharray="{DASHES}""#)
            }
            _ => format!(r#"stroke="{color}" stroke-width="2.6" stroke-opacity="0.8""#),
        }
    }

    fn drawn(self, color: &str, dark: &str, x: f64, y: f64) -> String {
        let square = |half_px: f64, look: &str| {
            let (left, top, edge) = (x - half_px, y - half_px, 2.0 * half_px);
            format!(
                r#"<rect x="{left:.1}" y="{top:.1}" width="{edge:.1}" height="{edge:.1}" {look}/>"#
            )
        };
        let circle = |radius_px: f64, look: &str| {
            format!(r#"<circle cx="{x:.1}" cy="{y:.1}" r="{radius_px:.1}" {look}/>"#)
        };
        match self {
            Self::Arm(_) => square(6.0, &format!(r#"fill="{color}""#)),
            Self::ObjectStart => {
                square(6.0, &format!(r##"fill="#ffffff" stroke="{color}" stroke-width="1.8""##))
            }
            Self::ObjectEnd => {
                square(4.0, &format!(r##"fill="{color}" stroke="#ffffff" stroke-width="0.8""##))
            }
            Self::End => {
                circle(4.0, &format!(r##"fill="{dark}" stroke="#ffffff" stroke-width="0.8""##))
            }
            Self::Stopped => format!(
                r#"<path d="M{:.1} {:.1}l12 12m0 -12l-12 12" fill="none" stroke="{dark}" stroke-width="2.6"/>"#,
                x - 6.0,
                y - 6.0
            ),
            Self::Goal => circle(
                7.0,
                &format!(r#"fill="{color}" fill-opacity="0.13" stroke="{color}" stroke-width="1""#),
            ),
            Self::Planned | Self::Measured => String::new(),
        }
    }
}

pub(super) fn hex(RGBColor(red, green, blue): RGBColor) -> String {
    format!("#{red:02x}{green:02x}{blue:02x}")
}
