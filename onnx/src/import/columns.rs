//! Normalisation of one column.

use tandem_policy::normalizer::CLIP;

use crate::binding::Source;
use crate::network::{Column, Op};

/// Standard deviation of a column that is not clipped. Observations lie within ±1000, and 5 · 256 exceeds that; a power
/// of two changes no digit of a weight.
const UNCLIPPED_STD: f32 = 256.0;

/// A column as a multiple of a policy's normalised input: `factor * clip((x - mean) / std, -5, 5) + offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Normalized {
    pub(super) mean: f32,
    pub(super) std: f32,
    pub(super) factor: f64,
    pub(super) offset: f64,
}

/// `scale * x + shift`.
#[derive(Debug, Clone, Copy)]
struct Affine {
    scale: f64,
    shift: f64,
}

impl Affine {
    const IDENTITY: Self = Self { scale: 1.0, shift: 0.0 };

    /// Returns this followed by `op`; `None` if `op` is not affine.
    fn then(self, op: Op) -> Option<Self> {
        let Self { scale, shift } = self;
        Some(match op {
            Op::Add(c) => Self { scale, shift: shift + f64::from(c) },
            Op::Sub(c) => Self { scale, shift: shift - f64::from(c) },
            Op::Mul(c) => Self { scale: scale * f64::from(c), shift: shift * f64::from(c) },
            Op::Div(c) => Self { scale: scale / f64::from(c), shift: shift / f64::from(c) },
            Op::Clip(..) | Op::Relu | Op::Tanh => return None,
        })
    }
}

/// Brings the operations of a column to the form of a policy. The policy gives actions to its critic as they are.
pub(super) fn normalized(source: Source, column: &Column) -> Result<Normalized, String> {
    let (mut before, mut after) = (Affine::IDENTITY, Affine::IDENTITY);
    let mut bounds: Option<[f32; 2]> = None;
    for op in &column.ops {
        let current = if bounds.is_none() { &mut before } else { &mut after };
        match (current.then(*op), *op, bounds) {
            (Some(next), ..) => *current = next,
            // Min and Max after another become the two bounds of a Clip.
            (None, Op::Clip(low, high), Some([old_low, old_high])) if is_plain(after) => {
                bounds = Some([old_low.max(low), old_high.min(high)]);
            }
            (None, Op::Clip(low, high), None) => bounds = Some([low, high]),
            (None, op, _) => {
                return Err(format!(
                    "{} is transformed by {op:?} before the first layer, expected a mean, a standard deviation and one \
                     clip",
                    name(source)
                ));
            }
        }
    }
    let bounds = bounds.filter(|bounds| !is_idle(source, before, *bounds));
    match (source, bounds) {
        (Source::Action(_), None) => {
            let joined = joined(before, after);
            Ok(Normalized { mean: 0.0, std: 1.0, factor: joined.scale, offset: joined.shift })
        }
        (Source::Action(_), Some(_)) => Err(format!("{} is clipped", name(source))),
        (_, None) => {
            let Affine { scale, shift } = joined(before, after);
            let std = UNCLIPPED_STD;
            Ok(Normalized { mean: 0.0, std, factor: scale * f64::from(std), offset: shift })
        }
        (_, Some(bounds)) => clipped(source, before, bounds, after),
    }
}

/// Returns `after` of `before`.
fn joined(before: Affine, after: Affine) -> Affine {
    Affine { scale: before.scale * after.scale, shift: before.shift * after.scale + after.shift }
}

#[expect(clippy::float_cmp, reason = "an untouched identity")]
fn is_plain(affine: Affine) -> bool {
    affine.scale == 1.0 && affine.shift == 0.0
}

/// Returns true if no valid number reaches the bounds.
fn is_idle(source: Source, before: Affine, [low, high]: [f32; 2]) -> bool {
    let largest = match source {
        Source::Action(_) => 1.0,
        Source::Observation(_) | Source::Goal(_) => f64::from(CLIP * UNCLIPPED_STD),
    };
    let reach = (before.scale * largest).abs();
    f64::from(low) <= before.shift - reach && before.shift + reach <= f64::from(high)
}

#[expect(clippy::cast_possible_truncation, reason = "statistics are stored as f32")]
fn clipped(
    source: Source,
    before: Affine,
    [low, high]: [f32; 2],
    after: Affine,
) -> Result<Normalized, String> {
    let (low, high) = (f64::from(low), f64::from(high));
    let half = (high - low) / 2.0;
    if !half.is_finite() || half <= 0.0 || before.scale == 0.0 {
        return Err(format!(
            "{} is clipped to {low} to {high}, expected two finite bounds",
            name(source)
        ));
    }
    let centre = f64::midpoint(low, high);
    // clip(z, low, high) = centre + half / 5 * clip((z - centre) * 5 / half, -5, 5)
    let factor = half / f64::from(CLIP);
    let mean = (centre - before.shift) / before.scale;
    let std = factor / before.scale;
    Ok(Normalized {
        mean: mean as f32,
        std: std.abs() as f32,
        factor: factor * after.scale * std.signum(),
        offset: centre * after.scale + after.shift,
    })
}

fn name(source: Source) -> String {
    match source {
        Source::Observation(i) => format!("observation {i}"),
        Source::Goal(i) => format!("goal {i}"),
        Source::Action(i) => format!("action {i}"),
    }
}
