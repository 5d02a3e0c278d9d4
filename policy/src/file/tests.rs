//! Round trips of policy files, and files that are refused.

use std::error::Error as _;
use std::fs;

use super::*;

fn sample() -> Policy {
    Policy::sample(Layout::new(Task::Push, 2), 2)
}

/// Changes the header of a file with `edit`.
fn with_header(bytes: &[u8], edit: impl FnOnce(&mut Map<String, Value>)) -> Vec<u8> {
    let (length, rest) = bytes.split_first_chunk::<8>().unwrap();
    let (header, data) = rest.split_at(usize::try_from(u64::from_le_bytes(*length)).unwrap());
    let mut header: Map<String, Value> = serde_json::from_slice(header).unwrap();
    edit(&mut header);
    let header = Value::Object(header).to_string().into_bytes();
    [&(header.len() as u64).to_le_bytes(), header.as_slice(), data].concat()
}

fn with_metadata(bytes: &[u8], key: &str, value: Option<&str>) -> Vec<u8> {
    with_header(bytes, |header| {
        let metadata = header["__metadata__"].as_object_mut().unwrap();
        match value {
            Some(value) => drop(metadata.insert(key.to_owned(), value.into())),
            None => drop(metadata.shift_remove(key)),
        }
    })
}

#[test]
fn a_policy_loads_as_it_was_saved() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("policy.safetensors");
    let policy = sample();
    policy.save(&path).unwrap();
    let loaded = Policy::load(&path).unwrap();
    assert_eq!(loaded, policy);
    assert_eq!(loaded.digest(), policy.digest());
    assert_eq!(fs::read(&path).unwrap(), encode(&loaded), "the same bytes again");
    let files: Vec<_> =
        fs::read_dir(directory.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(files, ["policy.safetensors"], "no other file remains");
}

/// A one-arm task that is not built-in.
fn described() -> TaskSpec {
    TaskSpec::new(TaskDescription {
        name: "reach".to_owned(),
        episode_steps: 20,
        tolerance: 0.1,
        ..Layout::new(Task::Push, 1).description()
    })
    .unwrap()
}

#[test]
fn a_policy_of_another_task_is_saved_with_its_description() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("policy.safetensors");
    let policy = Policy::sample(described(), 1);
    policy.save(&path).unwrap();
    let loaded = Policy::load(&path).unwrap();
    assert_eq!(loaded, policy);
    assert_eq!(loaded.task.tolerance(), 0.1);
    let version = |policy: &Policy| metadata(policy)["format_version"].clone();
    assert_eq!((version(&policy), version(&sample())), ("2".to_owned(), "1".to_owned()));
    assert!(!metadata(&sample()).contains_key("description"));
}

#[test]
fn an_unusable_description_is_refused_with_the_reason() {
    let bytes = encode(&Policy::sample(described(), 1));
    let check = |description: Option<&str>, reason: &str| {
        let message = decode(&with_metadata(&bytes, "description", description)).unwrap_err();
        assert!(message.to_string().contains(reason), "{message}");
    };
    check(None, "\"description\" is missing");
    check(Some("{}"), "the description of a task: missing field");
    let text = metadata(&Policy::sample(described(), 1))["description"].clone();
    let changed = |from: &str, to: &str| text.replace(from, to);
    check(Some(&changed("\"tolerance\":0.1", "\"tolerance\":-1.0")), "tolerance: expected a");
    check(Some(&changed("\"n_action\":3", "\"n_action\":2")), "arms[0].action[2]: expected 0 to 1");
    let built_in = json!(Layout::new(Task::Push, 1).description()).to_string();
    check(Some(&built_in), "push is built-in, which is version 1");
}

#[test]
fn every_number_enters_the_digest() {
    let policy = sample();
    let check = |change: fn(&mut Policy)| {
        let mut changed = policy.clone();
        change(&mut changed);
        assert_ne!(changed.digest(), policy.digest());
    };
    check(|policy| policy.actor[0] += 1.0);
    check(|policy| *policy.critic.last_mut().unwrap() += 1.0);
    check(|policy| policy.observation_normalizer.std[5] += 1.0);
    check(|policy| policy.goal_normalizer.mean[0] += 1.0);
}

#[test]
fn an_invalid_policy_does_not_overwrite_a_file() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("policy.safetensors");
    let policy = sample();
    policy.save(&path).unwrap();
    let mut broken = policy.clone();
    broken.critic[3] = f32::INFINITY;
    assert!(matches!(broken.save(&path), Err(Error::NotFinite { name: "critic" })));
    assert_eq!(Policy::load(&path).unwrap(), policy);
    let nowhere = directory.path().join("missing").join("policy.safetensors");
    assert!(matches!(policy.save(&nowhere), Err(Error::Write { .. })));
    assert!(matches!(policy.save(Path::new("/")), Err(Error::Write { .. })));
}

#[test]
fn files_that_are_not_policies_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("policy.safetensors");
    assert!(matches!(Policy::load(&path), Err(Error::Read { .. })), "no such file");
    assert!(matches!(Policy::load(directory.path()), Err(Error::Read { .. })), "a directory");
    let whole = encode(&sample());
    for bytes in
        [&[][..], b"not a policy at all", &whole[..9], &whole[..500], &whole[..whole.len() - 1]]
    {
        fs::write(&path, bytes).unwrap();
        let error = Policy::load(&path).expect_err("must be refused");
        assert!(error.to_string().contains("policy.safetensors"), "{error}");
        let reason = error.source().unwrap().to_string();
        assert_eq!(reason, "not a complete safetensors file", "{} bytes", bytes.len());
    }
    assert!(decode(&[whole.as_slice(), &[0]].concat()).is_err(), "one byte too many");
}

#[test]
fn metadata_that_does_not_match_is_refused() {
    let whole = encode(&sample());
    let check = |key, value, expected: &str| {
        let error = decode(&with_metadata(&whole, key, value)).expect_err("must be refused");
        assert_eq!(error.to_string(), expected);
    };
    check(
        "format",
        Some("tandem-poems"),
        r#"metadata "format" is "tandem-poems", expected "tandem-policy""#,
    );
    check("format", None, r#"metadata "format" is missing"#);
    check("format_version", Some("3"), r#"metadata "format_version" is "3", expected "1" or "2""#);
    check(
        "task",
        Some("juggle"),
        r#"metadata "task" is "juggle", expected one of push, pick-and-place, shared-push, shared-pick-and-place, carry-bar"#,
    );
    check("n_hidden", Some("-1"), r#"metadata "n_hidden" is "-1", expected 1 to 16384"#);
    check("n_hidden_layers", None, r#"metadata "n_hidden_layers" is missing"#);
    check("n_observation", Some("55"), r#"metadata "n_observation" is "55", expected 56"#);
    check("activation", Some("gelu"), r#"metadata "activation" is "gelu", expected relu"#);
    check("normalizer_clip", None, r#"metadata "normalizer_clip" is missing"#);
}

#[test]
fn sizes_that_the_tensors_do_not_have_are_refused() {
    let whole = encode(&sample());
    let check = |key, value, expected: &str| {
        let error = decode(&with_metadata(&whole, key, Some(value))).expect_err("must be refused");
        assert_eq!(error.to_string(), expected);
    };
    let weight = r#"tensor "actor.layers.0.weight" is F32 [32, 62], expected"#;
    check("n_arms", "1", &format!("{weight} F32 [32, 31]"));
    check("n_arms", "8", &format!("{weight} F32 [32, 248]"));
    check("n_hidden", "16", &format!("{weight} F32 [16, 62]"));
    check(
        "task",
        "pick-and-place",
        r#"tensor "actor.layers.2.weight" is F32 [6, 32], expected F32 [8, 32]"#,
    );
    check(
        "n_heads",
        "1",
        r#"tensor "critic.0.layers.2.weight" is F32 [2, 32], expected F32 [1, 32]"#,
    );
    check(
        "n_hidden_layers",
        "3",
        r#"tensor "actor.layers.2.weight" is F32 [6, 32], expected F32 [32, 32]"#,
    );
}

#[test]
fn a_critic_has_one_value_or_one_for_each_arm() {
    let layout = Layout::new(Task::Push, 2);
    for n_heads in 1..=3 {
        let refusal = decode(&encode(&Policy::sample(layout, n_heads))).err();
        let expected = "n_heads is 3, expected 1 or the number of arms, 2".to_owned();
        let expected = (n_heads == 3).then_some(expected);
        assert_eq!(refusal.map(|error| error.to_string()), expected);
    }
}

#[test]
fn tensors_that_are_not_as_expected_are_refused() {
    let whole = encode(&sample());
    let check = |edit: fn(&mut Map<String, Value>), expected: &str| {
        let error = decode(&with_header(&whole, edit)).expect_err("must be refused");
        assert_eq!(error.to_string(), expected);
    };
    let rename = |header: &mut Map<String, Value>| {
        let tensor = header.shift_remove("normalizer.goal.std").unwrap();
        header.insert("normalizer.goal.sigma".to_owned(), tensor);
    };
    check(rename, r#"tensor "normalizer.goal.std" is missing"#);
    let transpose = |header: &mut Map<String, Value>| {
        header["critic.0.layers.0.weight"]["shape"] = json!([68, 32]);
    };
    check(transpose, r#"tensor "critic.0.layers.0.weight" is F32 [68, 32], expected F32 [32, 68]"#);
    let retype =
        |header: &mut Map<String, Value>| header["actor.layers.0.bias"]["dtype"] = json!("I32");
    check(retype, r#"tensor "actor.layers.0.bias" is I32 [32], expected F32 [32]"#);
    let add = |header: &mut Map<String, Value>| {
        let end = header["normalizer.goal.std"]["data_offsets"][1].clone();
        let tensor = json!({ "dtype": "F32", "shape": [0], "data_offsets": [end, end] });
        header.insert("actor.norm.0.weight".to_owned(), tensor);
    };
    check(add, r#"tensor "actor.norm.0.weight" is unknown"#);
}

#[test]
fn invalid_and_altered_numbers_are_refused() {
    let check = |change: fn(&mut Policy), expected: &str| {
        let mut policy = sample();
        change(&mut policy);
        assert_eq!(decode(&encode(&policy)).expect_err("must be refused").to_string(), expected);
    };
    check(|policy| policy.actor[9] = f32::NAN, "actor holds a number that is not finite");
    check(
        |policy| policy.goal_normalizer.mean[0] = f32::INFINITY,
        "goal mean holds a number that is not finite",
    );
    check(
        |policy| policy.goal_normalizer.std[2] = -0.1,
        "goal std holds a number that is not above 0",
    );

    let mut altered = encode(&sample());
    *altered.last_mut().unwrap() ^= 1;
    assert!(matches!(decode(&altered), Err(FormatError::Digest { .. })));
    let undigested = with_metadata(&altered, "digest", None);
    assert!(decode(&undigested).is_ok(), "a file that another program wrote");
}
