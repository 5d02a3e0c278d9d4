//! Normalisation of one column.

use tandem_policy::normalizer::CLIP;

use crate::binding::Source;
use crate::network::{Column, Op};

/// Smallest standard deviation of a column that is not clipped. A power of two changes no digit of a weight.
const UNCLIPPED_STD: f32 = 256.0;
/// Largest standard deviation of a column that is not clipped: ordinary numbers remain normal floats when they are
/// divided by it.
const MAX_UNCLIPPED_STD: f32 = (1_u128 << 90) as f32;

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

/// Brings the operations of a column to the form of a policy. The policy gives actions to its critic as they are. The
/// column's numbers are within ±`bound`.
pub(super) fn normalized(
    source: Source,
    column: &Column,
    bound: f32,
) -> Result<Normalized, String> {
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
    let is_action = matches!(source, Source::Action(_));
    let bounds = bounds.filter(|bounds| {
        let is_needed = !is_action && clipped_std(before, *bounds).is_some();
        is_needed || !is_idle(before, *bounds, bound)
    });
    match (source, bounds) {
        (Source::Action(_), None) => {
            let joined = joined(before, after);
            Ok(Normalized { mean: 0.0, std: 1.0, factor: joined.scale, offset: joined.shift })
        }
        (Source::Action(_), Some(_)) => Err(format!("{} is clipped", name(source))),
        (_, None) => {
            let Affine { scale, shift } = joined(before, after);
            let std = unclipped_std(bound);
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

/// Returns true if no number within ±`largest` reaches the bounds.
fn is_idle(before: Affine, [low, high]: [f32; 2], largest: f32) -> bool {
    let reach = (before.scale * f64::from(largest)).abs();
    f64::from(low) <= before.shift - reach && before.shift + reach <= f64::from(high)
}

/// Returns the standard deviation with which a policy clips at the bounds; negative if they are reversed. `None` if a
/// policy cannot: a bound is infinite, or so large that it means none.
fn clipped_std(before: Affine, [low, high]: [f32; 2]) -> Option<f64> {
    let half = (f64::from(high) - f64::from(low)) / 2.0;
    let std = half / f64::from(CLIP) / before.scale;
    (half > 0.0 && std.abs() <= f64::from(MAX_UNCLIPPED_STD)).then_some(std)
}

/// Returns a standard deviation with which numbers within ±`bound` are not clipped: the smallest power of two from
/// [`UNCLIPPED_STD`] on, but at most [`MAX_UNCLIPPED_STD`].
fn unclipped_std(bound: f32) -> f32 {
    let mut std = UNCLIPPED_STD;
    while CLIP * std < bound && std < MAX_UNCLIPPED_STD {
        std *= 2.0;
    }
    std
}

#[expect(clippy::cast_possible_truncation, reason = "statistics are stored as f32")]
fn clipped(
    source: Source,
    before: Affine,
    [low, high]: [f32; 2],
    after: Affine,
) -> Result<Normalized, String> {
    let Some(std) = clipped_std(before, [low, high]) else {
        return Err(format!(
            "{} is clipped to {low} to {high}, expected two finite bounds",
            name(source)
        ));
    };
    let centre = f64::midpoint(f64::from(low), f64::from(high));
    // clip(z, low, high) = centre + half / 5 * clip((z - centre) * 5 / half, -5, 5)
    let factor = std * before.scale;
    let mean = (centre - before.shift) / before.scale;
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
