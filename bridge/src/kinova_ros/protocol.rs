//! The JSON messages to and from rosbridge. Pure.
//!
//! The formats are version 2 of rosbridge's protocol, ROS 1's message types, and kinova-ros as of February 2023.

use serde_json::{Value, json};
use tandem_core::text::shortened;
use tandem_kinematics::Joints;

use crate::driver::{ArmReading, DriverError, Faults};

/// The number of joints of an arm.
pub(crate) const N_JOINTS: usize = 4;
/// The number of fingers of a gripper.
const N_FINGERS: usize = 2;
/// The largest number of characters of a message in an error.
const MAX_SHOWN_CHARS: usize = 200;
/// The level of errors in `rosgraph_msgs/Log`.
const LOG_ERROR: u64 = 8;
/// kinova-ros reports a finger's turns as an angle of its joint: degrees per turn.
const FINGER_DEGREES_PER_TURN: f64 = 80.0 / 6800.0;

/// A message of rosbridge.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum RosMessage {
    /// A published message.
    Publish { topic: String, msg: Value },
    /// The response of a service.
    ServiceResponse { id: String, result: bool, values: Value },
    /// An error reported by rosbridge.
    Error(String),
    /// Any other message, which is ignored.
    Other,
}

/// Parses a message of rosbridge.
pub(crate) fn parse(text: &str) -> Result<RosMessage, DriverError> {
    let message: Value = serde_json::from_str(text).map_err(|error| {
        malformed(format!("not JSON: {error}: {}", shortened(text, MAX_SHOWN_CHARS)))
    })?;
    let word = |key: &str| message.get(key).and_then(Value::as_str).unwrap_or_default().to_owned();
    let value = |key: &str| message.get(key).cloned().unwrap_or(Value::Null);
    Ok(match word("op").as_str() {
        "publish" => RosMessage::Publish { topic: word("topic"), msg: value("msg") },
        "service_response" => RosMessage::ServiceResponse {
            id: word("id"),
            result: value("result").as_bool().unwrap_or(false),
            values: value("values"),
        },
        "status" if word("level") == "error" => {
            RosMessage::Error(shortened(&word("msg"), MAX_SHOWN_CHARS))
        }
        _ => RosMessage::Other,
    })
}

/// Advertises `topic` with a queue of one message.
pub(crate) fn advertise(topic: &str, kind: &str) -> String {
    json!({"op": "advertise", "topic": topic, "type": kind, "queue_size": 1}).to_string()
}

/// Subscribes to the newest messages of `topic`: the queue has one entry, which newer messages replace.
pub(crate) fn subscribe(topic: &str, kind: &str) -> String {
    subscribe_with(topic, kind, 1)
}

/// Subscribes to all messages of `topic`.
pub(crate) fn subscribe_to_all(topic: &str, kind: &str) -> String {
    subscribe_with(topic, kind, 0)
}

fn subscribe_with(topic: &str, kind: &str, queue_length: u32) -> String {
    json!({
        "op": "subscribe", "topic": topic, "type": kind,
        "queue_length": queue_length, "throttle_rate": 0,
    })
    .to_string()
}

/// Calls a service without arguments.
pub(crate) fn call(id: &str, service: &str) -> String {
    json!({"op": "call_service", "id": id, "service": service}).to_string()
}

/// Publishes velocities (radians per second) as `kinova_msgs/JointVelocity` (degrees per second).
///
/// Joint 7, which these arms lack, carries the last three digits of the command's number, in millionths of a degree per
/// second.
pub(crate) fn velocities(topic: &str, number: u64, rates: &Joints) -> Result<String, DriverError> {
    let (got, expected) = (rates.len(), N_JOINTS);
    if got != expected {
        return Err(DriverError::Shape { got, expected });
    }
    if !rates.iter().all(|rate| rate.is_finite()) {
        return Err(DriverError::Refused { what: "a velocity is not finite".into() });
    }
    let [joint1, joint2, joint3, joint4] = std::array::from_fn(|joint| rates[joint].to_degrees());
    let msg = json!({
        "joint1": joint1, "joint2": joint2, "joint3": joint3, "joint4": joint4,
        "joint5": 0.0, "joint6": 0.0, "joint7": label(number),
    });
    Ok(json!({"op": "publish", "topic": topic, "msg": msg}).to_string())
}

/// The velocity of joint 7 in command `number`, degrees per second.
fn label(number: u64) -> f64 {
    (number % 1000) as f64 * 1e-6
}

/// Returns true if a message of `kinova_msgs/JointVelocity`, which has single precision, is that of command `number`.
pub(crate) fn is_velocity_of(msg: &Value, number: u64, rates: &Joints) -> bool {
    let near = |joint: usize, expected: f64, tolerance: f64| {
        let got = msg.get(format!("joint{joint}")).and_then(Value::as_f64);
        got.is_some_and(|got| (got - expected).abs() < tolerance)
    };
    let rates = rates.iter().map(|rate| rate.to_degrees());
    (1..).zip(rates).all(|(joint, rate)| near(joint, rate, 1e-3)) && near(7, label(number), 1e-7)
}

/// Publishes a goal for both fingers, in turns, as `kinova_msgs/SetFingersPositionActionGoal`.
pub(crate) fn finger_goal(topic: &str, id: &str, turns: f64) -> String {
    let now = json!({"secs": 0, "nsecs": 0});
    let msg = json!({
        "header": {"seq": 0, "stamp": now, "frame_id": ""},
        "goal_id": {"stamp": now, "id": id},
        // The third finger, which the gripper lacks, must be 0.
        "goal": {"fingers": {"finger1": turns, "finger2": turns, "finger3": 0.0}},
    });
    json!({"op": "publish", "topic": topic, "msg": msg}).to_string()
}

/// Publishes a goal for all joints, given in radians, as `kinova_msgs/ArmJointAnglesActionGoal`, in degrees.
pub(crate) fn angles_goal(topic: &str, id: &str, angles: &Joints) -> String {
    let now = json!({"secs": 0, "nsecs": 0});
    let [joint1, joint2, joint3, joint4] = std::array::from_fn(|joint| angles[joint].to_degrees());
    let msg = json!({
        "header": {"seq": 0, "stamp": now, "frame_id": ""},
        "goal_id": {"stamp": now, "id": id},
        "goal": {"angles": {
            "joint1": joint1, "joint2": joint2, "joint3": joint3, "joint4": joint4,
            "joint5": 0.0, "joint6": 0.0, "joint7": 0.0,
        }},
    });
    json!({"op": "publish", "topic": topic, "msg": msg}).to_string()
}

/// Returns the angles of a message of `kinova_msgs/JointAngles`, in radians.
pub(crate) fn joint_degrees(msg: &Value) -> Option<Joints> {
    let degrees = |joint: usize| msg.get(format!("joint{joint}")).and_then(Value::as_f64);
    let degrees = [degrees(1)?, degrees(2)?, degrees(3)?, degrees(4)?];
    Some(Joints::new(&degrees.map(f64::to_radians)))
}

/// Returns true if a goal has succeeded, by the result of its action.
pub(crate) fn has_succeeded(msg: &Value) -> bool {
    msg.pointer("/status/status").and_then(Value::as_u64) == Some(3)
}

/// Returns the node and the text of an error or a fatal error in a message of `rosgraph_msgs/Log`.
pub(crate) fn logged_error(msg: &Value) -> Option<(&str, String)> {
    let level = msg.get("level").and_then(Value::as_u64)?;
    let word = |key: &str| msg.get(key).and_then(Value::as_str);
    (level >= LOG_ERROR).then_some((word("name")?, shortened(word("msg")?, MAX_SHOWN_CHARS)))
}

/// Returns the identifier of the goal that has ended from the result of an action.
pub(crate) fn ended_goal(msg: &Value) -> Option<&str> {
    msg.pointer("/status/goal_id/id")?.as_str()
}

/// The state of an arm at one time.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ArmMessage {
    /// The time stamp by ROS' clock, seconds.
    pub(crate) stamp_s: f64,
    pub(crate) reading: ArmReading,
}

/// Decodes the messages of an arm.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ArmDecoder<'a> {
    /// The prefix of the joints' names, before `joint_` and a number.
    pub(crate) prefix: &'a str,
    /// The turns of a closed finger.
    pub(crate) shut_turns: f64,
    /// True if efforts are torques without the arm's own weight.
    pub(crate) reports_torques: bool,
}

impl ArmDecoder<'_> {
    /// Decodes a message of `sensor_msgs/JointState` with joints in any order: angles in radians, rates in radians per
    /// second, efforts in newton metres.
    pub(crate) fn joint_state(&self, msg: &Value) -> Result<ArmMessage, DriverError> {
        let names = list(msg, "name")?;
        let names: Vec<&str> = names.iter().map(|name| name.as_str().unwrap_or("")).collect();
        let joints = self.indices::<N_JOINTS>(&names, "joint_")?;
        let fingers = self.indices::<N_FINGERS>(&names, "joint_finger_")?;
        self.check_no_other_joints(&names)?;
        let numbers = |key: &str| -> Result<Vec<f64>, DriverError> {
            let values = list(msg, key)?;
            if values.len() != names.len() {
                let (got, expected) = (values.len(), names.len());
                return Err(malformed(format!("{got} numbers in {key} for {expected} joints")));
            }
            let number = |(value, name): (&Value, &&str)| {
                let number = value.as_f64().filter(|number| number.is_finite());
                number.ok_or_else(|| malformed(format!("{key} of {name} is {value}, not a number")))
            };
            values.iter().zip(&names).map(number).collect()
        };
        let of_joints = |numbers: &[f64]| Joints::from_fn(N_JOINTS, |joint| numbers[joints[joint]]);
        let positions = numbers("position")?;
        let torques_nm =
            if self.reports_torques { Some(of_joints(&numbers("effort")?)) } else { None };
        let turns = fingers.map(|finger| positions[finger].to_degrees() / FINGER_DEGREES_PER_TURN);
        let turns = turns.iter().sum::<f64>() / N_FINGERS as f64;
        let reading = ArmReading {
            angles: of_joints(&positions),
            velocities: of_joints(&numbers("velocity")?),
            torques_nm,
            opening: 1.0 - turns / self.shut_turns,
            faults: Faults::default(),
        };
        Ok(ArmMessage { stamp_s: stamp_s(msg)?, reading })
    }

    /// Returns the turns of the fingers for an opening, 0 to 1.
    pub(crate) fn turns(&self, opening: f64) -> f64 {
        (1.0 - opening.clamp(0.0, 1.0)) * self.shut_turns
    }

    /// Returns the indices of joints 1 to `N` in `names`.
    fn indices<const N: usize>(
        &self,
        names: &[&str],
        kind: &str,
    ) -> Result<[usize; N], DriverError> {
        let mut indices = [0; N];
        for (joint, found_idx) in indices.iter_mut().enumerate() {
            let name = format!("{}{kind}{}", self.prefix, joint + 1);
            let mut found = (0..names.len()).filter(|idx| names[*idx] == name);
            *found_idx = match (found.next(), found.next()) {
                (Some(idx), None) => idx,
                (None, _) => {
                    let known = shortened(&names.join(" "), MAX_SHOWN_CHARS);
                    return Err(malformed(format!("no joint {name:?} among {known:?}")));
                }
                (Some(_), Some(_)) => return Err(malformed(format!("joint {name:?} twice"))),
            };
        }
        Ok(indices)
    }

    /// Checks that the arm has no other joints.
    fn check_no_other_joints(&self, names: &[&str]) -> Result<(), DriverError> {
        let tips = |name: &&str| {
            name.strip_prefix(self.prefix).is_some_and(|name| name.starts_with("joint_finger_tip_"))
        };
        let got = names.iter().filter(|name| !tips(name)).count();
        let expected = N_JOINTS + N_FINGERS;
        if got == expected { Ok(()) } else { Err(DriverError::Shape { got, expected }) }
    }
}

fn stamp_s(msg: &Value) -> Result<f64, DriverError> {
    let part = |key: &str| msg.pointer(&format!("/header/stamp/{key}")).and_then(Value::as_f64);
    let stamp_s = part("secs").zip(part("nsecs")).map(|(secs, nsecs)| secs + 1e-9 * nsecs);
    stamp_s
        .filter(|stamp_s| stamp_s.is_finite())
        .ok_or_else(|| malformed("a joint state without a stamp of secs and nsecs".into()))
}

fn list<'a>(msg: &'a Value, key: &str) -> Result<&'a Vec<Value>, DriverError> {
    let value = msg.get(key).and_then(Value::as_array);
    value.ok_or_else(|| malformed(format!("a joint state without a list {key:?}")))
}

fn malformed(what: String) -> DriverError {
    DriverError::Malformed { what }
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::index;
    use tandem_core::{Stream, episode_rng};

    use super::*;

    const DECODER: ArmDecoder<'static> =
        ArmDecoder { prefix: "m1n4s200_", shut_turns: 6400.0, reports_torques: false };

    /// A state as the driver of a `m1n4s200` publishes it.
    fn joint_state() -> Value {
        let names = ["joint_1", "joint_2", "joint_3", "joint_4"].into_iter().chain([
            "joint_finger_1",
            "joint_finger_2",
            "joint_finger_tip_1",
            "joint_finger_tip_2",
        ]);
        let names: Vec<String> = names.map(|name| format!("m1n4s200_{name}")).collect();
        json!({
            "header": {"seq": 4, "stamp": {"secs": 1_700_000_000, "nsecs": 250_000_000}, "frame_id": ""},
            "name": names,
            "position": [4.5, 3.25, 1.5, -0.5, 0.6571, 0.6571, 0.0, 0.0],
            "velocity": [0.1, -0.2, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0],
            "effort": [0.5, 6.0, 2.0, -0.25, 0.0, 0.0, 0.0, 0.0],
        })
    }

    #[test]
    fn a_joint_state_is_read_by_names() {
        let message = DECODER.joint_state(&joint_state()).unwrap();
        assert_eq!(message.stamp_s, 1_700_000_000.25);
        assert_eq!(message.reading.angles, Joints::new(&[4.5, 3.25, 1.5, -0.5]));
        assert_eq!(message.reading.velocities, Joints::new(&[0.1, -0.2, 0.3, 0.0]));
        assert_eq!(message.reading.torques_nm, None);
        // 0.6571 rad are 37.65 degrees, at 80 degrees for 6800 turns 3200 turns of 6400.
        assert!((message.reading.opening - 0.5).abs() < 1e-3, "{}", message.reading.opening);

        let torques = ArmDecoder { reports_torques: true, ..DECODER };
        let read = torques.joint_state(&joint_state()).unwrap();
        assert_eq!(read.reading.torques_nm, Some(Joints::new(&[0.5, 6.0, 2.0, -0.25])));

        let mut turned = joint_state();
        for key in ["name", "position", "velocity", "effort"] {
            turned[key].as_array_mut().unwrap().reverse();
        }
        assert_eq!(DECODER.joint_state(&turned).unwrap(), message);
    }

    #[test]
    fn a_malformed_joint_state_is_refused_with_its_fault() {
        let check = |spoil: &dyn Fn(&mut Value), expected: &str| {
            let mut msg = joint_state();
            spoil(&mut msg);
            let error = DECODER.joint_state(&msg).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        };
        check(&|msg| msg["position"][2] = Value::Null, "position of m1n4s200_joint_3 is null");
        check(&|msg| msg["velocity"][0] = json!("NaN"), "velocity of m1n4s200_joint_1");
        check(&|msg| msg["name"][1] = json!("j2n6s300_joint_2"), "no joint \"m1n4s200_joint_2\"");
        check(&|msg| msg["name"][1] = json!("m1n4s200_joint_1"), "\"m1n4s200_joint_1\" twice");
        check(
            &|msg| msg["name"][7] = json!("m1n4s200_joint_5"),
            "for 7 arms or joints, expected 6",
        );
        check(&|msg| msg["position"] = json!([1.0, 2.0]), "2 numbers in position for 8 joints");
        check(&|msg| msg["header"] = Value::Null, "without a stamp");
        check(&|msg| *msg = Value::Null, "without a list \"name\"");
    }

    #[test]
    fn velocities_are_sent_in_degrees_per_second() {
        let rates = Joints::new(&[0.1, -0.2, 0.0, std::f64::consts::PI / 6.0]);
        let sent: Value =
            serde_json::from_str(&velocities("/a/in/joint_velocity", 41_234, &rates).unwrap())
                .unwrap();
        assert_eq!(sent["op"], "publish");
        assert_eq!(sent["topic"], "/a/in/joint_velocity");
        let joint = |nth: usize| sent["msg"][format!("joint{nth}")].as_f64().unwrap();
        let expected = [5.729_578, -11.459_156, 0.0, 30.0, 0.0, 0.0, 0.000_234];
        for (nth, expected) in (1..).zip(expected) {
            assert!((joint(nth) - expected).abs() < 5e-7, "joint {nth}: {sent}");
        }
        assert_eq!(sent["msg"].as_object().unwrap().len(), 7);
        assert!(
            is_velocity_of(&sent["msg"], 41_234, &rates)
                && is_velocity_of(&sent["msg"], 234, &rates)
        );
        assert!(!is_velocity_of(&sent["msg"], 41_235, &rates));
        let other = Joints::from_fn(4, |joint| rates[joint] + if joint == 2 { 0.001 } else { 0.0 });
        assert!(!is_velocity_of(&sent["msg"], 41_234, &other));
        assert!(!is_velocity_of(&json!({"joint1": 0.0}), 0, &Joints::new(&[0.0; 4])));
        let nan = Joints::new(&[0.0, f64::NAN, 0.0, 0.0]);
        assert!(matches!(velocities("/a", 1, &nan), Err(DriverError::Refused { .. })));
        assert!(matches!(
            velocities("/a", 1, &Joints::new(&[0.0; 6])),
            Err(DriverError::Shape { .. })
        ));
    }

    #[test]
    fn openings_and_turns_correspond() {
        for (opening, turns) in [(1.0, 0.0), (0.0, 6400.0), (0.75, 1600.0), (1.5, 0.0)] {
            assert_eq!(DECODER.turns(opening), turns);
        }
        let sent: Value = serde_json::from_str(&finger_goal("/a/goal", "7", 1600.0)).unwrap();
        assert_eq!(
            sent["msg"]["goal"]["fingers"],
            json!({"finger1": 1600.0, "finger2": 1600.0, "finger3": 0.0})
        );
        assert_eq!(
            ended_goal(&json!({"status": {"goal_id": {"id": "7"}, "status": 3}})),
            Some("7")
        );
        assert_eq!(ended_goal(&json!({"status": 3})), None);
    }

    #[test]
    fn rosbridge_is_understood() {
        let check = |text: &str, expected: RosMessage| assert_eq!(parse(text).unwrap(), expected);
        check(
            r#"{"op": "publish", "topic": "/t", "msg": {"a": 1}}"#,
            RosMessage::Publish { topic: "/t".into(), msg: json!({"a": 1}) },
        );
        check(
            r#"{"op": "service_response", "id": "3", "service": "/s", "values": "no", "result": false}"#,
            RosMessage::ServiceResponse { id: "3".into(), result: false, values: json!("no") },
        );
        check(
            r#"{"op": "status", "level": "error", "msg": "no such type"}"#,
            RosMessage::Error("no such type".into()),
        );
        check(r#"{"op": "status", "level": "warning", "msg": "well"}"#, RosMessage::Other);
        check("[]", RosMessage::Other);
        // Python writes numbers that are none like this.
        assert!(parse(r#"{"op": "publish", "topic": "/t", "msg": {"position": [NaN]}}"#).is_err());
    }

    #[test]
    fn no_message_makes_the_reader_panic() {
        let good = json!({"op": "publish", "topic": "/t", "msg": joint_state()}).to_string();
        let (mut n_read, mut n_refused) = (0, 0);
        for seed in 0..20_000 {
            let mut rng = episode_rng(seed, 0, Stream::Reset);
            let mut text = good.clone().into_bytes();
            for _ in 0..1 + index(&mut rng, 4) {
                let at = index(&mut rng, text.len());
                match index(&mut rng, 3) {
                    0 => text[at] = b" \"{}[],:0123456789.-eNnul"[index(&mut rng, 25)],
                    1 => drop(text.drain(at..(at + 1 + index(&mut rng, 20)).min(text.len()))),
                    _ => text[at] = 32 + u8::try_from(index(&mut rng, 95)).unwrap(),
                }
            }
            let text = String::from_utf8(text).unwrap();
            match parse(&text) {
                Ok(RosMessage::Publish { msg, .. }) => match DECODER.joint_state(&msg) {
                    Ok(message) => {
                        n_read += 1;
                        let reading = message.reading;
                        let numbers = reading.angles.iter().chain(reading.velocities.iter());
                        assert!(numbers.chain([&reading.opening]).all(|n| n.is_finite()), "{text}");
                    }
                    Err(_) => n_refused += 1,
                },
                Ok(_) => {}
                Err(_) => n_refused += 1,
            }
        }
        assert!(n_read > 300 && n_refused > 5000, "{n_read} read, {n_refused} refused");
    }
}
