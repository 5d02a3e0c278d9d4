//! Learning curves as SVG.

use plotters::coord::Shift;
use plotters::prelude::{
    ChartBuilder, Color as _, DashedLineSeries, DrawingArea, IntoDrawingArea as _, IntoFont as _,
    LineSeries, Polygon, RGBColor, Rectangle, SVGBackend, Text, TextStyle, WHITE,
};
use tandem_telemetry::MetricsRow;

use crate::error::Error;
use crate::quantity::Quantity;
use crate::table::short_number;
use layout::{
    LEGEND_LEFT_PX, LEGEND_LINE_PX, LEGEND_PX, LegendEntry, legend_entries, n_legend_lines, wrapped,
};

pub(crate) mod layout;
mod marker;

/// Colours of the series, distinguishable by colour-blind readers and of different brightness. Markers distinguish
/// them without colours. Further series reuse both, with dashed lines.
const COLORS: [RGBColor; 6] = [
    RGBColor(0x00, 0x5f, 0xa8),
    RGBColor(0xe0, 0x7b, 0x28),
    RGBColor(0x00, 0x8f, 0x6b),
    RGBColor(0xb0, 0x58, 0x9a),
    RGBColor(0x24, 0x29, 0x2f),
    RGBColor(0x56, 0xa8, 0xdc),
];
/// Number of markers on a curve, about.
const N_MARKERS: usize = 10;
/// Sizes of text, pixels. A plot is about as wide as half a page, so they are the sizes that readers see.
const TITLE_PX: u32 = 15;
const TICK_PX: u32 = 12;
/// Height of a line of the title, and distance of the first from the upper edge, pixels.
const TITLE_LINE_PX: i32 = 20;
const TITLE_TOP_PX: i32 = 14;
/// Width of plots for narrow screens, pixels. Their axes have fewer and larger labels.
pub(crate) const NARROW_PX: u32 = 360;
pub(crate) const INK: RGBColor = RGBColor(0x24, 0x29, 0x2f);
pub(crate) const FAINT_INK: RGBColor = RGBColor(0x6a, 0x73, 0x7d);
pub(crate) const GRID: RGBColor = RGBColor(0xe6, 0xe9, 0xed);
pub(crate) const FONT: &str = "-apple-system, 'Segoe UI', Helvetica, Arial, sans-serif";

/// The horizontal axis of a curve.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axis {
    /// Environment steps of training.
    EnvSteps,
    /// Updates of the networks.
    Updates,
    /// Wall time, minutes.
    Minutes,
    /// Epochs as the paper counts them.
    PaperEpochs,
}

impl Axis {
    /// Returns the label of the axis.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::EnvSteps => "environment steps",
            Self::Updates => "updates",
            Self::Minutes => "wall time, minutes",
            Self::PaperEpochs => "paper epochs",
        }
    }

    /// Returns a part of a title.
    pub(crate) const fn against(self) -> &'static str {
        match self {
            Self::EnvSteps => "against environment steps",
            Self::Updates => "against updates",
            Self::Minutes => "against wall time",
            Self::PaperEpochs => "against paper epochs",
        }
    }

    /// Returns a part of a file name.
    pub(crate) const fn slug(self) -> &'static str {
        match self {
            Self::EnvSteps => "environment-steps",
            Self::Updates => "updates",
            Self::Minutes => "minutes",
            Self::PaperEpochs => "paper-epochs",
        }
    }

    /// Returns the coordinate of `row` on this axis.
    pub(crate) fn of(self, row: &MetricsRow) -> f64 {
        match self {
            Self::EnvSteps => row.env_steps as f64,
            Self::Updates => row.updates as f64,
            Self::Minutes => row.wall_s / 60.0,
            Self::PaperEpochs => row.paper_epochs,
        }
    }
}

/// A point of a curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CurvePoint {
    /// Coordinate on the horizontal axis.
    pub x: f64,
    /// Value.
    pub y: f64,
    /// Lower and upper bound of its interval, if it has one.
    pub band: Option<(f64, f64)>,
}

/// One curve.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points, from left to right.
    pub points: Vec<CurvePoint>,
}

impl Series {
    /// Creates the curve of `quantity` against `axis`. Rows without a finite value are omitted.
    #[must_use]
    pub fn of(name: &str, rows: &[MetricsRow], axis: Axis, quantity: Quantity) -> Self {
        let point = |row: &MetricsRow| CurvePoint {
            x: axis.of(row),
            y: quantity.of(row),
            band: quantity.interval(row),
        };
        let points =
            rows.iter().map(point).filter(|point| point.x.is_finite() && point.y.is_finite());
        Self { name: name.to_owned(), points: points.collect() }
    }
}

/// Options of a plot of curves.
#[derive(Debug, Clone, PartialEq)]
pub struct CurveOptions {
    /// Title, above the curves.
    pub title: String,
    /// Label of the horizontal axis.
    pub x_label: String,
    /// Label of the vertical axis.
    pub y_label: String,
    /// `true` if the values are shares, which are drawn on an axis from 0 to 100 %.
    pub percent: bool,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
}

impl CurveOptions {
    /// Returns options for `quantity` against `axis`, 560 by 360 pixels.
    #[must_use]
    pub fn of(title: &str, quantity: Quantity, axis: Axis) -> Self {
        Self {
            title: title.to_owned(),
            x_label: axis.label().to_owned(),
            y_label: quantity.label().to_owned(),
            percent: quantity.is_share(),
            width: 560,
            height: 360,
        }
    }

    /// Returns the same for screens on which a plot of 560 pixels would be too small to read, 360 by 270 pixels.
    #[must_use]
    pub fn narrow(self) -> Self {
        Self { width: NARROW_PX, height: 270, ..self }
    }
}

/// A drawing as SVG, at the width of half a page and at that of a phone; a page shows one of them.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Drawing {
    /// For wide screens.
    pub(crate) wide: String,
    /// For narrow screens, and for print with two columns.
    pub(crate) narrow: String,
}

/// Draws curves for wide and for narrow screens.
///
/// # Errors
/// If the plotting library fails.
pub(crate) fn curve_drawing(series: &[Series], options: CurveOptions) -> Result<Drawing, Error> {
    // A legend with many lines would leave no room for the curves; a wide drawing has room for two.
    let legend_px = |width| LEGEND_LINE_PX * n_legend_lines(&legend(series, width));
    let more_px = (legend_px(options.width) - 2 * LEGEND_LINE_PX).max(0);
    let mut narrow = options.clone().narrow();
    narrow.height += legend_px(narrow.width).unsigned_abs();
    let wide = CurveOptions { height: options.height + more_px.unsigned_abs(), ..options };
    Ok(Drawing { wide: curve_svg(series, &wide)?, narrow: curve_svg(series, &narrow)? })
}

/// Draws `series` with their bands and a legend as SVG.
///
/// # Errors
/// If the plotting library fails, for example because the plot is too small for its labels.
pub fn curve_svg(series: &[Series], options: &CurveOptions) -> Result<String, Error> {
    let mut svg = String::new();
    draw(series, options, &mut svg).map_err(|error| Error::Draw {
        title: options.title.clone(),
        problem: error.to_string(),
    })?;
    Ok(svg)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type DrawResult = Result<(), Box<dyn std::error::Error>>;

fn draw(series: &[Series], options: &CurveOptions, svg: &mut String) -> DrawResult {
    let root = SVGBackend::with_string(svg, (options.width, options.height)).into_drawing_area();
    root.fill(&WHITE)?;
    let legend = legend(series, options.width);
    draw_header(&root, &legend, options)?;
    let header_px = legend_top_px(options) + LEGEND_LINE_PX * n_legend_lines(&legend);
    let (_, plot) = root.split_vertically(header_px);
    draw_plot(&plot, series, options)?;
    root.present()?;
    Ok(())
}

/// Lays out the legend on as many lines as needed. A single curve has no legend.
fn legend(series: &[Series], width_px: u32) -> Vec<LegendEntry> {
    let named = series.iter().filter(|_| series.len() > 1).map(|one| one.name.as_str());
    legend_entries(named, width_px)
}

/// Draws the title and the legend.
fn draw_header(root: &Area<'_>, legend: &[LegendEntry], options: &CurveOptions) -> DrawResult {
    let title = (FONT, TITLE_PX).into_font().style(plotters::style::FontStyle::Bold).color(&INK);
    let mut top = TITLE_TOP_PX;
    for line in title_lines(options) {
        root.draw(&Text::new(line, (LEGEND_LEFT_PX, top), title.clone()))?;
        top += TITLE_LINE_PX;
    }
    for (idx, LegendEntry { name, left, line }) in legend.iter().enumerate() {
        let (color, middle) = (COLORS[idx % COLORS.len()], legend_top_px(options) + 7);
        let middle = middle + LEGEND_LINE_PX * line;
        // A dashed line has a gap on both sides of its marker.
        let dashes = if idx < COLORS.len() { &[(0, 16)][..] } else { &[(-2, 1), (15, 18)] };
        for (begin, end) in dashes {
            let corners = [(left + begin, middle - 1), (left + end, middle + 1)];
            root.draw(&Rectangle::new(corners, color.filled()))?;
        }
        marker::draw_in_legend(root, idx, (left + 8, middle), color)?;
        let mut top = middle - 7;
        for line in name {
            let style = text_style(LEGEND_PX, INK);
            root.draw(&Text::new(line.clone(), (left + 22, top), style))?;
            top += LEGEND_LINE_PX;
        }
    }
    Ok(())
}

/// Returns the upper edge of the legend, pixels.
fn legend_top_px(options: &CurveOptions) -> i32 {
    let n_lines = i32::try_from(title_lines(options).len()).unwrap_or(i32::MAX / 64);
    TITLE_TOP_PX + TITLE_LINE_PX * n_lines + 6
}

/// Breaks the title into lines that fit into the plot.
fn title_lines(options: &CurveOptions) -> Vec<String> {
    let room_px = i32::try_from(options.width).unwrap_or(i32::MAX) - 2 * LEGEND_LEFT_PX;
    wrapped(&options.title, TITLE_PX + 1, room_px)
}

fn draw_plot(plot: &Area<'_>, series: &[Series], options: &CurveOptions) -> DrawResult {
    let (x_max, y_range) = (x_max(series), y_range(series, options.percent));
    let mut chart = ChartBuilder::on(plot)
        .margin_left(6)
        .margin_right(24)
        .margin_bottom(6)
        .margin_top(8)
        .x_label_area_size(42)
        .y_label_area_size(62)
        .build_cartesian_2d(0.0..x_max, y_range.clone())?;
    let is_narrow = options.width <= NARROW_PX;
    let y_label =
        |y: &f64| if options.percent { format!("{:.0} %", 100.0 * y) } else { short_number(*y) };
    chart
        .configure_mesh()
        .disable_x_mesh()
        .light_line_style(plotters::style::TRANSPARENT)
        .bold_line_style(GRID)
        .axis_style(GRID)
        .x_desc(options.x_label.as_str())
        .y_desc(options.y_label.as_str())
        .x_labels(if is_narrow { 4 } else { 6 })
        .y_labels(6)
        .x_label_formatter(&|x| short_number(*x))
        .y_label_formatter(&y_label)
        .label_style(text_style(if is_narrow { LEGEND_PX } else { TICK_PX }, FAINT_INK))
        .axis_desc_style(text_style(LEGEND_PX, INK))
        .draw()?;
    for (one, color) in series.iter().zip(COLORS.iter().cycle()) {
        chart.draw_series(band(one).map(|outline| Polygon::new(outline, color.mix(0.16))))?;
    }
    for (idx, one) in series.iter().enumerate() {
        let color = COLORS[idx % COLORS.len()];
        let line = one.points.iter().map(|point| (point.x, point.y));
        match idx < COLORS.len() {
            true => chart.draw_series(LineSeries::new(line, color.stroke_width(2)))?,
            false => chart.draw_series(DashedLineSeries::new(line, 6, 4, color.stroke_width(2)))?,
        };
        marker::draw(&mut chart, idx, &marked_points(one), color)?;
    }
    Ok(())
}

/// Returns the points of a curve that have a marker: the last, and others at equal distances before it.
fn marked_points(series: &Series) -> Vec<(f64, f64)> {
    let step = series.points.len().div_ceil(N_MARKERS).max(1);
    series.points.iter().rev().step_by(step).map(|point| (point.x, point.y)).collect()
}

/// Returns the outline of a curve's band, if it has one.
fn band(series: &Series) -> impl Iterator<Item = Vec<(f64, f64)>> {
    let side = |end: fn((f64, f64)) -> f64| {
        series
            .points
            .iter()
            .filter_map(move |point| Some((point.x, end(point.band?))))
            .collect::<Vec<_>>()
    };
    let (lower, upper) = (side(|band| band.0), side(|band| band.1));
    let outline: Vec<_> = lower.into_iter().chain(upper.into_iter().rev()).collect();
    (outline.len() > 2).then_some(outline).into_iter()
}

fn x_max(series: &[Series]) -> f64 {
    let largest =
        series.iter().flat_map(|one| &one.points).map(|point| point.x).fold(0.0, f64::max);
    if largest > 0.0 { largest } else { 1.0 }
}

fn y_range(series: &[Series], percent: bool) -> std::ops::Range<f64> {
    if percent {
        return 0.0..1.0;
    }
    // The plotting library never returns from a range whose length is not finite.
    const LARGEST: f64 = f64::MAX / 8.0;
    let points = || series.iter().flat_map(|one| &one.points);
    let values = || points().map(|point| point.y.clamp(-LARGEST, LARGEST));
    let (low, high) = (values().fold(0.0, f64::min), values().fold(0.0, f64::max));
    let room = 0.06 * (high - low);
    match high > low {
        true => {
            (if low < 0.0 { low - room } else { low })..(if high > 0.0 {
                high + room
            } else {
                high
            })
        }
        false => 0.0..1.0,
    }
}

fn text_style(size_px: u32, color: RGBColor) -> TextStyle<'static> {
    (FONT, size_px).into_font().color(&color)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_without_a_value_is_omitted_from_the_curve() {
        let row = |mean_q| MetricsRow { updates: 1, mean_q, ..MetricsRow::default() };
        let initial = MetricsRow { mean_q: 0.0, ..MetricsRow::default() };
        let series = Series::of(
            "run",
            &[initial, row(f64::NAN), row(-3.0)],
            Axis::EnvSteps,
            Quantity::MeanQ,
        );
        assert_eq!(series.points, [CurvePoint { x: 0.0, y: -3.0, band: None }]);
    }

    #[test]
    fn a_long_title_has_several_lines() {
        let title = "push, 2 arms: success against wall time, thresholds of mc-act-abs (Figure 5d)";
        let options = CurveOptions::of(title, Quantity::Success, Axis::Minutes);
        let lines = title_lines(&options);
        assert_eq!((lines.len(), lines.join(" ").as_str()), (2, title));
        assert_eq!(legend_top_px(&options), 60);
    }

    #[test]
    fn a_narrow_drawing_keeps_the_height_of_its_curves() {
        let named = |name: String| Series { name, points: Vec::new() };
        let height_px = |n: usize| {
            let series: Vec<Series> =
                (0..n).map(|idx| named(format!("{idx} ").repeat(24))).collect();
            let options = CurveOptions::of("Success", Quantity::Success, Axis::EnvSteps);
            let svg = curve_drawing(&series, options).expect("it is large enough").narrow;
            let (_, rest) = svg.split_once("height=\"").expect("a height");
            rest.split('"').next().and_then(|px| px.parse::<u32>().ok())
        };
        assert_eq!([1, 2, 6].map(height_px), [Some(270), Some(310), Some(390)]);
    }

    #[test]
    fn the_last_point_of_a_curve_has_a_marker() {
        let points = |n: u32| Series {
            name: String::new(),
            points: (0..n).map(|x| CurvePoint { x: f64::from(x), y: 0.5, band: None }).collect(),
        };
        for n in [1, 9, 10, 11, 100] {
            let marked = marked_points(&points(n));
            assert_eq!(marked[0].0, f64::from(n - 1));
            assert!(marked.len() <= N_MARKERS, "{n}");
        }
        assert!(marked_points(&points(0)).is_empty());
    }

    #[test]
    fn the_value_axis_covers_all_values_and_zero() {
        let series = |values: &[f64]| Series {
            name: String::new(),
            points: values.iter().map(|y| CurvePoint { x: 1.0, y: *y, band: None }).collect(),
        };
        let range = y_range(&[series(&[-8.0, -2.0])], false);
        assert!(range.start < -8.0 && range.end == 0.0, "{range:?}");
        assert_eq!(y_range(&[series(&[])], false), 0.0..1.0);
        let range = y_range(&[series(&[-f64::MAX, f64::MAX])], false);
        assert!((range.end - range.start).is_finite(), "{range:?}");
    }
}
