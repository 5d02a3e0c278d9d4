//! The allowed values of a cell file.

use crate::cell_file::{Arm, CellFile, CellFileError, Limits, MODELS, N_ARMS, Simulated, model};

/// Most characters of an arm's name.
const MAX_NAME: usize = 32;
/// Smallest and largest distance between two bases, metres. A base is about 0.15 m wide.
const BASES_APART_M: [f64; 2] = [0.15, 4.0];
/// Range of a base's height over the table, metres.
const BASE_OVER_TABLE_M: [f64; 2] = [-0.3, 0.3];

impl CellFile {
    /// Checks every value.
    pub(super) fn checked(self) -> Result<Self, CellFileError> {
        if let Some(mean_s) = self.torque_mean_s {
            number("torque_mean_s", mean_s, [0.1, 2.0], "s")?;
            if self.reports_torques.is_some() {
                let got = format!("{mean_s}");
                return Err(value("torque_mean_s", got, "no such key with reports_torques"));
            }
        }
        number("table.height_m", self.table.height_m, [-1.0, 1.0], "m")?;
        if self.arms.len() != N_ARMS {
            return Err(value("arms", format!("{} arms", self.arms.len()), "2 arms"));
        }
        for (idx, arm) in self.arms.iter().enumerate() {
            arm.check(&format!("arms[{idx}]"), self.table.height_m, &self.limits)?;
        }
        let [first, second] = [&self.arms[0], &self.arms[1]];
        if first.name == second.name {
            return Err(value("arms[1].name", format!("{:?}", second.name), "a name of its own"));
        }
        if first.ros_node() == second.ros_node() {
            return Err(value(
                "arms[1].ros_node",
                format!("{:?}", second.ros_node()),
                "an own node",
            ));
        }
        let apart = first.base_m.iter().zip(second.base_m).map(|(a, b)| (a - b) * (a - b));
        let apart_m = apart.sum::<f64>().sqrt();
        number("the distance of arms[1].base_m from arms[0].base_m", apart_m, BASES_APART_M, "m")?;
        self.limits.check()?;
        self.simulated.check()?;
        Ok(self)
    }
}

impl Arm {
    fn check(&self, key: &str, table_m: f64, limits: &Limits) -> Result<(), CellFileError> {
        let is_plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "-_".contains(c);
        let name = &self.name;
        if name.is_empty() || name.chars().count() > MAX_NAME || !name.chars().all(is_plain) {
            let expected = "1 to 32 lower-case letters, digits, - and _";
            return Err(value(format!("{key}.name"), format!("{name:?}"), expected));
        }
        if model(&self.model).is_none() {
            let known: Vec<&str> = MODELS.iter().map(|model| model.name).collect();
            let got = format!("{:?}", self.model);
            return Err(value(format!("{key}.model"), got, known.join(" or ")));
        }
        for (axis, at_m) in self.base_m.into_iter().enumerate() {
            number(format!("{key}.base_m[{axis}]"), at_m, [-3.0, 3.0], "m")?;
        }
        let over_m = self.base_m[2] - table_m;
        number(
            format!("the height of {key}.base_m over the table"),
            over_m,
            BASE_OVER_TABLE_M,
            "m",
        )?;
        number(format!("{key}.yaw_degrees"), self.yaw_degrees, [-360.0, 360.0], "degrees")?;
        self.check_times(key, limits)?;
        let ros =
            [("ros_node", &self.ros_node, "/"), ("ros_joint_prefix", &self.ros_joint_prefix, "")];
        for (name, got, start) in ros {
            let Some(got) = got else { continue };
            let is_name = |part: &str| {
                !part.is_empty() && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
            };
            if !got.strip_prefix(start).is_some_and(|names| names.split('/').all(is_name)) {
                let expected = match start {
                    "" => "a prefix of letters, digits and _",
                    _ => "a ROS name that begins with /",
                };
                return Err(value(format!("{key}.{name}"), format!("{got:?}"), expected));
            }
        }
        Ok(())
    }

    /// Checks the times, which are given together or not at all.
    fn check_times(&self, key: &str, limits: &Limits) -> Result<(), CellFileError> {
        let times = self.times();
        let Some((given, _)) = times.iter().find(|(_, value)| value.is_some()) else {
            return Ok(());
        };
        if let Some((missing, _)) = times.iter().find(|(_, value)| value.is_none()) {
            let expected = format!("a time, because {key}.{given} is given: measure all three");
            return Err(value(format!("{key}.{missing}"), "missing".to_owned(), expected));
        }
        let (lag_s, reaction_s) = (self.lag_s.unwrap_or(0.0), self.reaction_s.unwrap_or(0.0));
        number(format!("{key}.reaction_s"), reaction_s, [0.01, 0.2], "s")?;
        // The feedback of the joints' angles oscillates with a lag of 0.125 s.
        number(format!("{key}.lag_s"), lag_s, [0.0, reaction_s.min(0.12)], "s")?;
        // The drives brake at least as hard as motions do.
        let brake_s = self.brake_s.unwrap_or(0.0);
        number(format!("{key}.brake_s"), brake_s, [0.001, limits.ramp_s.min(0.25)], "s")
    }
}

impl Limits {
    fn check(&self) -> Result<(), CellFileError> {
        let least = Self::default();
        // A motion keeps a wider gap than the envelope, so that its stopping paths keep the envelope's.
        let over = |gap_m: f64, least_m: f64| least_m.max(gap_m + 0.001);
        let numbers = [
            ("tool_speed_mps", self.tool_speed_mps, [0.01, 0.5], "m/s"),
            ("ramp_s", self.ramp_s, [0.1, 2.0], "s"),
            ("opening_per_s", self.opening_per_s, [0.05, 2.0], "1/s"),
            ("tilt_degrees", self.tilt_degrees, [5.0, 90.0], "degrees"),
            ("reach_share", self.reach_share, [0.3, 0.99], ""),
            ("table_gap_m", self.table_gap_m, [least.table_gap_m, 0.1], "m"),
            ("arms_gap_m", self.arms_gap_m, [least.arms_gap_m, 0.2], "m"),
            ("self_gap_m", self.self_gap_m, [least.self_gap_m, 0.05], "m"),
            (
                "check_table_gap_m",
                self.check_table_gap_m,
                [over(self.table_gap_m, least.check_table_gap_m), 0.2],
                "m",
            ),
            (
                "check_arms_gap_m",
                self.check_arms_gap_m,
                [over(self.arms_gap_m, least.check_arms_gap_m), 0.4],
                "m",
            ),
            (
                "check_self_gap_m",
                self.check_self_gap_m,
                [over(self.self_gap_m, least.check_self_gap_m), 0.1],
                "m",
            ),
            ("tracking_degrees", self.tracking_degrees, [0.2, 5.0], "degrees"),
            ("torque_nm", self.torque_nm, [0.5, 20.0], "N m"),
        ];
        numbers.into_iter().try_for_each(|(key, value, range, unit)| {
            number(format!("limits.{key}"), value, range, unit)
        })
    }
}

impl Simulated {
    fn check(&self) -> Result<(), CellFileError> {
        let [low, high] = self.latency_periods;
        let key = |end: usize| format!("simulated.latency_periods[{end}]");
        number(key(0), f64::from(low), [1.0, 10.0], "periods")?;
        number(key(1), f64::from(high), [f64::from(low), 10.0], "periods")?;
        number("simulated.lag_s", self.lag_s, [0.001, 0.1], "s")?;
        number("simulated.brake_s", self.brake_s, [0.005, 0.25], "s")
    }
}

/// Checks that a number is in its range, which NaN never is.
fn number(
    key: impl Into<String>,
    value: f64,
    [low, high]: [f64; 2],
    unit: &'static str,
) -> Result<(), CellFileError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(CellFileError::Range { key: key.into(), value, low, high, unit })
}

fn value(key: impl Into<String>, value: String, expected: impl Into<String>) -> CellFileError {
    CellFileError::Value { key: key.into(), value, expected: expected.into() }
}
