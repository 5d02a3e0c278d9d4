//! Singular postures: how much the tool moves at least when the joints do.

use crate::forward::ForwardKinematics;
use crate::joints::MAX_JOINTS;

/// Length that weighs turning against moving where both count, metres: about that of a hand.
const TURN_WEIGHT_M: f64 = 0.1;

/// Sweeps over all off-diagonal elements; each about squares what is left of them.
const SWEEPS: usize = 8;

/// The smallest displacement of the tool, metres per radian of all joints together, in the worst direction.
///
/// With four joints only the place counts (joint 4 does nothing for it), with six also the turn, weighed with 0.1 m per
/// radian. 0 in a singular posture.
pub(crate) fn manipulability_m(posture: &ForwardKinematics, n_joints: usize) -> f64 {
    let mut columns = [[0.0; 6]; MAX_JOINTS];
    for (joint, column) in columns.iter_mut().enumerate().take(n_joints) {
        let (along, axis) = posture.tool_motion(joint);
        let turn = if n_joints < 6 { glam::DVec3::ZERO } else { axis * TURN_WEIGHT_M };
        *column = [along.x, along.y, along.z, turn.x, turn.y, turn.z];
    }
    let square = |a: usize, b: usize| columns.iter().map(|column| column[a] * column[b]).sum();
    let eigenvalue = if n_joints < 6 {
        least_eigenvalue::<3>(std::array::from_fn(|a| std::array::from_fn(|b| square(a, b))))
    } else {
        least_eigenvalue::<6>(std::array::from_fn(|a| std::array::from_fn(|b| square(a, b))))
    };
    eigenvalue.max(0.0).sqrt()
}

/// The least eigenvalue of a symmetric matrix, by Jacobi's rotations.
fn least_eigenvalue<const N: usize>(mut matrix: [[f64; N]; N]) -> f64 {
    for _ in 0..SWEEPS {
        for p in 0..N {
            for q in p + 1..N {
                rotate(&mut matrix, p, q);
            }
        }
    }
    (0..N).map(|idx| matrix[idx][idx]).fold(f64::INFINITY, f64::min)
}

/// Makes element (`p`, `q`) vanish by a rotation in the plane of both.
fn rotate<const N: usize>(matrix: &mut [[f64; N]; N], p: usize, q: usize) {
    if matrix[p][q].abs() < 1e-18 {
        return;
    }
    let theta = (matrix[q][q] - matrix[p][p]) / (2.0 * matrix[p][q]);
    let tan = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let cos = 1.0 / (tan * tan + 1.0).sqrt();
    let sin = tan * cos;
    for row in matrix.iter_mut() {
        (row[p], row[q]) = (cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]);
    }
    let (above, below) = matrix.split_at_mut(q);
    for (a, b) in above[p].iter_mut().zip(&mut below[0]) {
        (*a, *b) = (cos * *a - sin * *b, sin * *a + cos * *b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_eigenvalue_of_a_known_matrix() {
        let matrix = [[2.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 5.0]];
        assert!((least_eigenvalue(matrix) - 1.0).abs() < 1e-12);
    }
}
