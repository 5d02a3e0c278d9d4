//! What is said to rosbridge and what it says: JSON to our types and back. Pure.
//!
//! The words are those of version 2 of rosbridge's protocol, ROS 1's message types, and kinova-ros (state of February 2023).

use serde_json::{Value, json};
use tandem_kinematics::Joints;

use crate::driver::{ArmReading, DriverError, Faults};

/// Joints of an arm.
pub(crate) const N_JOINTS: usize = 4;
/// Fingers of a gripper.
const N_FINGERS: usize = 2;
/// kinova-ros tells a finger's turn as an angle of its joint: degrees for each unit of turn.
const FINGER_DEGREES_PER_TURN: f64 = 80.0 / 6800.0;

/// A message that has come.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Heard {
    /// Somebody published.
    Message { topic: String, msg: Value },
    /// A service has answered.
    Answer { id: String, result: bool, values: Value },
    /// rosbridge could not do what it was asked for.
    Complaint(String),
    /// What needs no attention.
    Other,
}

/// Reads what rosbridge says.
pub(crate) fn hear(text: &str) -> Result<Heard, DriverError> {
    let message: Value = serde_json::from_str(text)
        .map_err(|error| malformed(format!("not JSON: {error}: {}", shortened(text))))?;
    let word = |key: &str| message.get(key).and_then(Value::as_str).unwrap_or_default().to_owned();
    let value = |key: &str| message.get(key).cloned().unwrap_or(Value::Null);
    Ok(match word("op").as_str() {
        "publish" => Heard::Message { topic: word("topic"), msg: value("msg") },
        "service_response" => Heard::Answer {
            id: word("id"),
            result: value("result").as_bool().unwrap_or(false),
            values: value("values"),
        },
        "status" if word("level") == "error" => Heard::Complaint(shortened(&word("msg"))),
        _ => Heard::Other,
    })
}

/// Announces that `topic` will be published. No queue that is longer than one message.
pub(crate) fn advertise(topic: &str, kind: &str) -> String {
    json!({"op": "advertise", "topic": topic, "type": kind, "queue_size": 1}).to_string()
}

/// Asks for the newest messages of `topic`: a queue of one message forgets the older one.
pub(crate) fn subscribe(topic: &str, kind: &str) -> String {
    subscribe_with(topic, kind, 1)
}

/// Asks for every message of `topic`.
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

/// Calls a service that takes nothing.
pub(crate) fn call(id: &str, service: &str) -> String {
    json!({"op": "call_service", "id": id, "service": service}).to_string()
}

/// Publishes velocities (radians per second) as `kinova_msgs/JointVelocity` (degrees per second).
///
/// Joint 7, which these arms do not have, carries the number of the command: its last three digits, in millionths of a degree per second.
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

/// What joint 7 is told in the command of this number, degrees per second.
fn label(number: u64) -> f64 {
    (number % 1000) as f64 * 1e-6
}

/// Whether a message of `kinova_msgs/JointVelocity` is that of this command. It has single precision.
pub(crate) fn is_of(msg: &Value, number: u64, rates: &Joints) -> bool {
    let near = |joint: usize, expected: f64, most: f64| {
        let told = msg.get(format!("joint{joint}")).and_then(Value::as_f64);
        told.is_some_and(|told| (told - expected).abs() < most)
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
        // A third finger that a gripper does not have has to be told 0.
        "goal": {"fingers": {"finger1": turns, "finger2": turns, "finger3": 0.0}},
    });
    json!({"op": "publish", "topic": topic, "msg": msg}).to_string()
}

/// The goal that has ended, of a message of `kinova_msgs/SetFingersPositionActionResult`.
pub(crate) fn ended_goal(msg: &Value) -> Option<&str> {
    msg.pointer("/status/goal_id/id")?.as_str()
}

/// An arm at one time.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Told {
    /// By ROS' clock, seconds.
    pub(crate) stamp_s: f64,
    pub(crate) reading: ArmReading,
}

/// How an arm's messages are to be read.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Reading<'a> {
    /// Joints are named this, `joint_` and a number.
    pub(crate) prefix: &'a str,
    /// Turns of a finger that is shut.
    pub(crate) shut_turns: f64,
    /// Whether efforts are torques without those that carry the arm.
    pub(crate) reports_torques: bool,
}

impl Reading<'_> {
    /// Reads a message of `sensor_msgs/JointState`: angles in radians, rates in radians per second, efforts in newton metres,
    /// in any order, by names.
    pub(crate) fn joint_state(&self, msg: &Value) -> Result<Told, DriverError> {
        let names = list(msg, "name")?;
        let names: Vec<&str> = names.iter().map(|name| name.as_str().unwrap_or("")).collect();
        let joints = self.places::<N_JOINTS>(&names, "joint_")?;
        let fingers = self.places::<N_FINGERS>(&names, "joint_finger_")?;
        self.nothing_else(&names)?;
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
        Ok(Told { stamp_s: stamp_s(msg)?, reading })
    }

    /// Turns of the fingers for an opening.
    pub(crate) fn turns(&self, opening: f64) -> f64 {
        (1.0 - opening.clamp(0.0, 1.0)) * self.shut_turns
    }

    /// Where joints 1 to `N` stand among `names`.
    fn places<const N: usize>(
        &self,
        names: &[&str],
        word: &str,
    ) -> Result<[usize; N], DriverError> {
        let mut places = [0; N];
        for (idx, place) in places.iter_mut().enumerate() {
            let name = format!("{}{word}{}", self.prefix, idx + 1);
            let mut found = (0..names.len()).filter(|place| names[*place] == name);
            *place = match (found.next(), found.next()) {
                (Some(place), None) => place,
                (None, _) => {
                    let known = shortened(&names.join(" "));
                    return Err(malformed(format!("no joint {name:?} among {known:?}")));
                }
                (Some(_), Some(_)) => return Err(malformed(format!("joint {name:?} twice"))),
            };
        }
        Ok(places)
    }

    /// The arm has no joints beyond those that it should have.
    fn nothing_else(&self, names: &[&str]) -> Result<(), DriverError> {
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

/// The beginning of what is too long for a message.
fn shortened(text: &str) -> String {
    text.chars().take(200).collect()
}

fn malformed(what: String) -> DriverError {
    DriverError::Malformed { what }
}

#[cfg(test)]
mod tests {
    use tandem_core::rng::index;
    use tandem_core::{Stream, episode_rng};

    use super::*;

    const READING: Reading<'static> =
        Reading { prefix: "m1n4s200_", shut_turns: 6400.0, reports_torques: false };

    /// What the driver of a `m1n4s200` publishes.
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
        let told = READING.joint_state(&joint_state()).unwrap();
        assert_eq!(told.stamp_s, 1_700_000_000.25);
        assert_eq!(told.reading.angles, Joints::new(&[4.5, 3.25, 1.5, -0.5]));
        assert_eq!(told.reading.velocities, Joints::new(&[0.1, -0.2, 0.3, 0.0]));
        assert_eq!(told.reading.torques_nm, None);
        // 0.6571 rad are 37.65 degrees, at 80 degrees for 6800 turns 3200 turns of 6400.
        assert!((told.reading.opening - 0.5).abs() < 1e-3, "{}", told.reading.opening);

        let torques = Reading { reports_torques: true, ..READING };
        let read = torques.joint_state(&joint_state()).unwrap();
        assert_eq!(read.reading.torques_nm, Some(Joints::new(&[0.5, 6.0, 2.0, -0.25])));

        let mut turned = joint_state();
        for key in ["name", "position", "velocity", "effort"] {
            turned[key].as_array_mut().unwrap().reverse();
        }
        assert_eq!(READING.joint_state(&turned).unwrap(), told);
    }

    #[test]
    fn what_is_no_joint_state_of_this_arm_says_why() {
        let check = |spoil: &dyn Fn(&mut Value), expected: &str| {
            let mut msg = joint_state();
            spoil(&mut msg);
            let error = READING.joint_state(&msg).unwrap_err().to_string();
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
    fn velocities_leave_in_degrees_per_second() {
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
        assert!(is_of(&sent["msg"], 41_234, &rates) && is_of(&sent["msg"], 234, &rates));
        assert!(!is_of(&sent["msg"], 41_235, &rates));
        let other = Joints::from_fn(4, |joint| rates[joint] + if joint == 2 { 0.001 } else { 0.0 });
        assert!(!is_of(&sent["msg"], 41_234, &other));
        assert!(!is_of(&json!({"joint1": 0.0}), 0, &Joints::new(&[0.0; 4])));
        let nan = Joints::new(&[0.0, f64::NAN, 0.0, 0.0]);
        assert!(matches!(velocities("/a", 1, &nan), Err(DriverError::Refused { .. })));
        assert!(matches!(
            velocities("/a", 1, &Joints::new(&[0.0; 6])),
            Err(DriverError::Shape { .. })
        ));
    }

    #[test]
    fn openings_and_turns_go_together() {
        for (opening, turns) in [(1.0, 0.0), (0.0, 6400.0), (0.75, 1600.0), (1.5, 0.0)] {
            assert_eq!(READING.turns(opening), turns);
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
        let check = |text: &str, expected: Heard| assert_eq!(hear(text).unwrap(), expected);
        check(
            r#"{"op": "publish", "topic": "/t", "msg": {"a": 1}}"#,
            Heard::Message { topic: "/t".into(), msg: json!({"a": 1}) },
        );
        check(
            r#"{"op": "service_response", "id": "3", "service": "/s", "values": "no", "result": false}"#,
            Heard::Answer { id: "3".into(), result: false, values: json!("no") },
        );
        check(
            r#"{"op": "status", "level": "error", "msg": "no such type"}"#,
            Heard::Complaint("no such type".into()),
        );
        check(r#"{"op": "status", "level": "warning", "msg": "well"}"#, Heard::Other);
        check("[]", Heard::Other);
        // Python writes numbers that are none like this.
        assert!(hear(r#"{"op": "publish", "topic": "/t", "msg": {"position": [NaN]}}"#).is_err());
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
            match hear(&text) {
                Ok(Heard::Message { msg, .. }) => match READING.joint_state(&msg) {
                    Ok(told) => {
                        n_read += 1;
                        let reading = told.reading;
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
