//! A measured value.

/// A measured value with its name and unit.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    /// The name, with `/` between its parts.
    pub name: String,
    /// The value, in `unit`.
    pub value: f64,
    /// The unit of `value`.
    pub unit: &'static str,
}

impl Figure {
    /// Creates a figure.
    pub fn new(name: impl Into<String>, value: f64, unit: &'static str) -> Self {
        Self { name: name.into(), value, unit }
    }
}
