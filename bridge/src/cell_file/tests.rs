use super::*;
use crate::Executor;
use crate::driver::{Command, Driver, DriverError, PairState};

/// An unused driver.
struct Idle;

impl Driver for Idle {
    fn period_s(&self) -> f64 {
        0.01
    }

    fn exchange(&mut self, _: &Command) -> Result<PairState, DriverError> {
        Err(DriverError::Disconnected { what: String::new() })
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        Ok(())
    }
}

/// Returns the default text with `from` replaced.
fn changed(from: &str, to: &str) -> String {
    assert!(DEFAULT_TEXT.contains(from), "{from}");
    DEFAULT_TEXT.replacen(from, to, 1)
}

#[test]
fn the_printed_cell_is_the_default_one() {
    let printed = CellFile::parse(DEFAULT_TEXT).unwrap();
    let mut default = CellFile::default();
    for (arm, printed) in default.arms.iter_mut().zip(&printed.arms) {
        for (at_m, printed_m) in arm.base_m.iter_mut().zip(printed.base_m) {
            // The training world's distances are single precision.
            assert!((*at_m - printed_m).abs() < 1e-8, "{at_m}");
            *at_m = printed_m;
        }
    }
    assert_eq!(printed, default);
}

#[test]
fn the_default_cell_is_that_of_trials_bit_for_bit() {
    let (file, expected) = (CellFile::default(), mico_cell());
    let cell = file.work_cell();
    for (got, expected) in cell.arms.iter().zip(&expected.arms) {
        let bits = |arm: &PlacedArm| {
            let at_m: [f64; 3] = arm.base_in_world_m.into();
            (at_m.map(f64::to_bits), arm.yaw_rad.to_bits(), arm.model.name)
        };
        assert_eq!(bits(got), bits(expected));
    }
    assert_eq!((cell.table_z_m, cell.task_frame), (expected.table_z_m, expected.task_frame));
    let settings = Settings::default();
    assert_eq!(file.settings(&settings), settings);
    let slow = crate::kinova_ros::settings();
    assert_eq!(file.settings(&slow), slow);
}

#[test]
fn every_value_reaches_the_executor() {
    let mut text = changed("height_m = 0.0", "height_m = 0.05");
    for (from, to) in [
        (
            "yaw_degrees = 0.0",
            "yaw_degrees = 10.0\nlag_s = 0.03\nreaction_s = 0.06\nbrake_s = 0.08",
        ),
        (
            "yaw_degrees = 180.0",
            "yaw_degrees = 170.0\nlag_s = 0.04\nreaction_s = 0.05\nbrake_s = 0.02",
        ),
        ("tool_speed_mps = 0.2", "tool_speed_mps = 0.1"),
        ("tilt_degrees = 45.0", "tilt_degrees = 30.0"),
        ("arms_gap_m = 0.02\n", "arms_gap_m = 0.05\n"),
        ("torque_nm = 4.0", "torque_nm = 3.0"),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replacen(from, to, 1);
    }
    let file = CellFile::parse(&text).unwrap();
    let cell = file.work_cell();
    assert_eq!(cell.table_z_m, 0.05);
    assert!((cell.arms[1].yaw_rad - 170.0_f64.to_radians()).abs() < 1e-12);
    let settings = file.settings(&Settings::default());
    // The slower arm counts, and a pause leaves time to brake.
    assert_eq!((settings.lag_s, settings.reaction_s, settings.brake_s), (0.04, 0.06, 0.08));
    assert_eq!(settings.pause_s, 0.16);
    assert_eq!((settings.check.limits.tool_speed_mps, settings.torque_nm), (0.1, 3.0));
    assert_eq!(settings.check.tilt_rad, 30.0_f64.to_radians());
    assert_eq!(settings.check.arms_gap_m, 0.05);
    assert!(file.arms.iter().all(Arm::is_measured));
    drop(Executor::new(cell, Idle, settings).unwrap());
}

#[test]
fn a_bad_value_is_refused_with_its_key_and_range() {
    let check = |from: &str, to: &str, expected: &str| {
        let error = CellFile::parse(&changed(from, to)).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
        assert!(!error.contains('\n'), "{error}");
    };
    check("height_m = 0.0", "height_m = nan", "table.height_m is NaN, expected -1 to 1 m");
    check("-0.39, 0.0", "-0.39, inf", "arms[0].base_m[1] is inf, expected -3 to 3 m");
    check("[-0.39, 0.0, 0.0]", "[-0.39, 0.0]", "line 18: ");
    check("[0.39, 0.0, 0.0]", "[-0.3, 0.0, 0.0]", "arms[1].base_m from arms[0].base_m is 0.09");
    check("yaw_degrees = 0.0", "yaw_degrees = 400.0", "arms[0].yaw_degrees is 400, expected -360");
    check("name = \"right\"", "name = \"left\"", "arms[1].name is \"left\", expected a name of");
    check(
        "name = \"left\"",
        "name = \"Left arm\"",
        "arms[0].name is \"Left arm\", expected 1 to 32",
    );
    check("m1n4s200\"  ", "j2n6s300\"  ", "arms[0].model is \"j2n6s300\", expected m1n4s200");
    check("ramp_s", "rampe_s", "unknown field `rampe_s`");
    check("[simulated]", "[[arms]]\nname = \"x\"\n[simulated]", "missing field `model`");
    // Margins cannot be narrowed.
    check("arms_gap_m = 0.012", "arms_gap_m = 0.011", "limits.arms_gap_m is 0.011, expected 0.012");
    check("table_gap_m = 0.004", "table_gap_m = 0.003", "limits.check_table_gap_m is 0.003");
    check(
        "self_gap_m = 0.002",
        "self_gap_m = 0.02",
        "limits.check_self_gap_m is 0.005, expected 0.021",
    );
    check(
        "yaw_degrees = 180.0",
        "yaw_degrees = 180.0\nlag_s = 0.02",
        "arms[1].reaction_s is missing",
    );
    let slow = "yaw_degrees = 0.0\nlag_s = 0.02\nreaction_s = 0.03\nbrake_s = 0.26";
    check("yaw_degrees = 0.0", slow, "arms[0].brake_s is 0.26, expected 0.001 to 0.25 s");
    let late = "yaw_degrees = 0.0\nlag_s = 0.05\nreaction_s = 0.03\nbrake_s = 0.05";
    check("yaw_degrees = 0.0", late, "arms[0].lag_s is 0.05, expected 0 to 0.03 s");
    check(
        "[-0.39, 0.0, 0.0]",
        "[-0.39, 0.0, 0.0, 0.0]",
        "line 18: invalid length 4, expected 3 numbers",
    );
    check("[1, 2]", "[1, 2, 3]", "invalid length 3, expected 2 numbers");
    for node in ["/", "/left/", "//left"] {
        let with_node = format!("yaw_degrees = 0.0\nros_node = {node:?}");
        check("yaw_degrees = 0.0", &with_node, "expected a ROS name that begins with /");
    }
    check("[1, 2]", "[3, 2]", "simulated.latency_periods[1] is 2, expected 3 to 10 periods");
    let one = DEFAULT_TEXT.split("[[arms]]\nname = \"right\"").next().unwrap();
    let error = CellFile::parse(one).unwrap_err().to_string();
    assert_eq!(error, "arms is 1 arms, expected 2 arms");
}

#[test]
fn measured_times_replace_nothing_else() {
    let timing = |lag_s| ArmTiming { lag_s, reaction_s: 0.05, brake_s: 0.06 };
    let text = with_timings(DEFAULT_TEXT, &[timing(0.021), timing(0.022)]).unwrap();
    let removed = |text: &str| -> Vec<String> {
        let is_time = |line: &&str| {
            ["lag_s = 0.02", "reaction_s = 0.05", "brake_s = 0.06"]
                .iter()
                .any(|key| line.starts_with(key))
        };
        text.lines().filter(|line| !is_time(line)).map(str::to_owned).collect()
    };
    assert_eq!(removed(&text), removed(DEFAULT_TEXT));
    let file = CellFile::parse(&text).unwrap();
    assert_eq!(file.timings(&Settings::default()), [timing(0.021), timing(0.022)]);
    assert!(file.arms.iter().all(Arm::is_measured));
    assert!(!CellFile::default().arms.iter().any(Arm::is_measured));
    // Measuring again replaces the times.
    let again = with_timings(&text, &[timing(0.03), timing(0.04)]).unwrap();
    assert_eq!(again.matches("\nlag_s = ").count(), 3, "{again}");
    let too_slow = ArmTiming { brake_s: 0.4, ..timing(0.02) };
    let error = with_timings(&text, &[too_slow, timing(0.02)]).unwrap_err().to_string();
    assert!(error.starts_with("arms[0].brake_s is 0.4, expected 0.001 to 0.25 s"), "{error}");
}
