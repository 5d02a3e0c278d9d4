//! Markers of curves, which distinguish them where colours do not.

use plotters::chart::ChartContext;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::{
    Cartesian2d, Circle, Color as _, Cross, EmptyElement, RGBColor, Rectangle, SVGBackend,
    TriangleMarker,
};

use super::{Area, DrawResult};

type Chart<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Half the width of a marker, pixels.
const HALF_PX: i32 = 4;
const SQUARE: [(i32, i32); 2] = [(-HALF_PX + 1, -HALF_PX + 1), (HALF_PX - 1, HALF_PX - 1)];

/// Draws the markers of the curve with this index.
pub(super) fn draw(
    chart: &mut Chart<'_, '_>,
    idx: usize,
    points: &[(f64, f64)],
    color: RGBColor,
) -> DrawResult {
    let points = points.iter().copied();
    match idx % 5 {
        0 => chart.draw_series(points.map(|at| Circle::new(at, HALF_PX, color.filled())))?,
        1 => chart
            .draw_series(points.map(|at| TriangleMarker::new(at, HALF_PX + 1, color.filled())))?,
        2 => chart.draw_series(
            points.map(|at| EmptyElement::at(at) + Rectangle::new(SQUARE, color.filled())),
        )?,
        3 => chart.draw_series(points.map(|at| Cross::new(at, HALF_PX, color.stroke_width(2))))?,
        _ => chart.draw_series(points.map(|at| Circle::new(at, HALF_PX, color.stroke_width(2))))?,
    };
    Ok(())
}

/// Draws the marker of the curve with this index at `at`, pixels.
pub(super) fn draw_in_legend(
    area: &Area<'_>,
    idx: usize,
    at: (i32, i32),
    color: RGBColor,
) -> DrawResult {
    match idx % 5 {
        0 => area.draw(&Circle::new(at, HALF_PX, color.filled()))?,
        1 => area.draw(&TriangleMarker::new(at, HALF_PX + 1, color.filled()))?,
        2 => {
            let square = SQUARE.map(|(x, y)| (at.0 + x, at.1 + y));
            area.draw(&Rectangle::new(square, color.filled()))?;
        }
        3 => area.draw(&Cross::new(at, HALF_PX, color.stroke_width(2)))?,
        _ => area.draw(&Circle::new(at, HALF_PX, color.stroke_width(2)))?,
    }
    Ok(())
}
