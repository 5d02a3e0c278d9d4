//! Markers of a trial's plot and of its legend.

use plotters::prelude::RGBColor;

use crate::color::arm_color;
use crate::curve::INK;

/// Dash pattern of planned paths.
const DASHES: &str = "5 3";

/// A marker or line style.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Marker {
    /// Colour of an arm.
    Arm(usize),
    /// Planned path of a tool.
    Planned,
    /// Measured path of a tool.
    Measured,
    /// Position of a tool when the trial failed.
    Stopped,
    /// Position of a tool at the end of a successful trial.
    End,
    /// Initial position of an object.
    ObjectStart,
    /// Final position of an object.
    ObjectEnd,
    /// A goal and its tolerance.
    Goal,
}

impl Marker {
    /// Returns the name in the legend.
    pub(super) fn name(self) -> String {
        match self {
            Self::Arm(arm) => return format!("arm {arm}"),
            Self::Planned => "tool, planned",
            Self::Measured => "tool, measured",
            Self::Stopped => "tool, when the trial failed",
            Self::End => "tool, at the end",
            Self::ObjectStart => "object, at the start",
            Self::ObjectEnd => "object, at the end",
            Self::Goal => "goal and its tolerance",
        }
        .to_owned()
    }

    /// Draws the marker of an arm at (`x`, `y`), pixels.
    pub(super) fn svg(self, arm: usize, x: f64, y: f64) -> String {
        self.shape(&arm_color(arm, 1.0), &arm_color(arm, 0.55), x, y)
    }

    /// Draws the marker of the legend at (`x`, `y`), pixels.
    pub(super) fn legend_svg(self, x: f64, y: f64) -> String {
        let ink = hex(INK);
        match self {
            Self::Arm(arm) => self.shape(&arm_color(arm, 1.0), &ink, x, y),
            Self::Planned | Self::Measured => {
                let (from, to) = (x - 8.5, x + 6.5);
                let stroke = self.stroke_of(&ink, &ink);
                format!(r#"<line x1="{from:.1}" y1="{y:.1}" x2="{to:.1}" y2="{y:.1}" {stroke}/>"#)
            }
            _ => self.shape(&ink, &ink, x, y),
        }
    }

    /// Returns the stroke attributes of an arm's path.
    pub(super) fn stroke(self, arm: usize) -> String {
        self.stroke_of(&arm_color(arm, 1.0), &arm_color(arm, 0.55))
    }

    /// Planned paths are drawn over measured ones: darker, thinner and dashed, so that both are visible where they
    /// coincide.
    fn stroke_of(self, color: &str, dark: &str) -> String {
        match self {
            Self::Planned => {
                format!(r#"stroke="{dark}" stroke-width="1.2" stroke-dasharray="{DASHES}""#)
            }
            _ => format!(r#"stroke="{color}" stroke-width="2.6" stroke-opacity="0.8""#),
        }
    }

    fn shape(self, color: &str, dark: &str, x: f64, y: f64) -> String {
        let square = |half_px: f64, style: &str| {
            let (left, top, edge) = (x - half_px, y - half_px, 2.0 * half_px);
            format!(
                r#"<rect x="{left:.1}" y="{top:.1}" width="{edge:.1}" height="{edge:.1}" {style}/>"#
            )
        };
        let circle = |radius_px: f64, style: &str| {
            format!(r#"<circle cx="{x:.1}" cy="{y:.1}" r="{radius_px:.1}" {style}/>"#)
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

/// Formats a colour for SVG.
pub(super) fn hex(RGBColor(red, green, blue): RGBColor) -> String {
    format!("#{red:02x}{green:02x}{blue:02x}")
}
