//! Manipulability: the distance of a configuration from a singular one.

use crate::forward::PositionJacobian;

/// Returns the smallest singular value of `jacobian`, metres per radian: the speed of the tool in its worst direction
/// per speed of all joints together. It is 0 in a singular configuration.
pub(crate) fn manipulability_m(jacobian: &PositionJacobian) -> f64 {
    let gram = jacobian * jacobian.transpose();
    gram.symmetric_eigenvalues().min().max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn manipulability_is_the_smallest_singular_value() {
        let mut jacobian = PositionJacobian::zeros();
        (jacobian[(0, 0)], jacobian[(1, 1)], jacobian[(2, 3)]) = (2.0, -0.5, 1.0);
        assert!((manipulability_m(&jacobian) - 0.5).abs() < 1e-12);
        jacobian[(1, 1)] = 0.0;
        assert!(manipulability_m(&jacobian) < 1e-12);
    }
}
