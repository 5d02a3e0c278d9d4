//! The layout for Foxglove shows what logs contain.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use prost_reflect::{DescriptorPool, DynamicMessage, ReflectMessage as _, Value as Field};
use serde_json::Value;

use crate::episode_log_tests::synthetic;

fn layout(name: &str) -> Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/foxglove").join(name);
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Returns the decoded messages of a log by topic.
pub(crate) fn messages(log: &Path) -> BTreeMap<String, Vec<DynamicMessage>> {
    let bytes = std::fs::read(log).unwrap();
    let mut messages: BTreeMap<String, Vec<DynamicMessage>> = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        let pool = DescriptorPool::decode(schema.data.as_ref()).unwrap();
        let descriptor = pool.get_message_by_name(&schema.name).unwrap();
        let decoded = DynamicMessage::decode(descriptor, message.data.as_ref()).unwrap();
        messages.entry(message.channel.topic.clone()).or_default().push(decoded);
    }
    messages
}

/// Returns whether `path`, such as `advice[0].importance`, leads to a value in `message`.
fn has_value(message: &DynamicMessage, path: &str) -> bool {
    let mut value = Field::Message(message.clone());
    for part in path.split('.') {
        let (name, index) = match part.split_once('[') {
            Some((name, index)) => (name, index.strip_suffix(']').unwrap().parse::<usize>().ok()),
            None => (part, None),
        };
        let Some(message) = value.as_message() else { return false };
        let Some(field) = message.descriptor().get_field_by_name(name) else { return false };
        if field.supports_presence() && !message.has_field(&field) {
            return false;
        }
        let found = message.get_field(&field).into_owned();
        value = match index {
            None => found,
            Some(index) => {
                let Some(element) = found.as_list().and_then(|list| list.get(index)) else {
                    return false;
                };
                element.clone()
            }
        };
    }
    true
}

/// Adds the texts of all message paths in `value`: a topic with or without a field.
fn collect_paths(value: &Value, paths: &mut BTreeSet<String>) {
    match value {
        Value::String(text) if text.starts_with('/') => drop(paths.insert(text.clone())),
        Value::Array(values) => values.iter().for_each(|value| collect_paths(value, paths)),
        Value::Object(entries) => {
            for (key, value) in entries {
                collect_paths(&Value::String(key.clone()), paths);
                collect_paths(value, paths);
            }
        }
        _ => {}
    }
}

/// Adds the panels of a part of the layout's tree.
fn collect_panels(node: &Value, panels: &mut BTreeSet<String>) {
    if let Value::String(panel) = node {
        assert!(panels.insert(panel.clone()), "{panel} is shown twice");
        return;
    }
    assert!(matches!(node["direction"].as_str(), Some("row" | "column")), "{node}");
    assert!(node["splitPercentage"].as_f64().is_some_and(|share| (1.0..=99.0).contains(&share)));
    collect_panels(&node["first"], panels);
    collect_panels(&node["second"], panels);
}

/// Checks that every path of a layout has values in `log`.
pub(crate) fn check_paths(name: &str, log: &Path) {
    let (layout, messages) = (layout(name), messages(log));
    let mut paths = BTreeSet::new();
    collect_paths(&layout["configById"], &mut paths);
    assert!(paths.len() > 10, "{paths:?}");
    for path in paths {
        let (topic, field) = path.split_once('.').unwrap_or((&path, ""));
        assert!(messages.contains_key(topic), "no topic {topic} in a log");
        let of_topic = &messages[topic];
        let is_found = field.is_empty() || of_topic.iter().any(|message| has_value(message, field));
        assert!(is_found, "no value at {path}");
    }
}

#[test]
fn every_path_of_the_layout_has_values_in_a_log() {
    let directory = tempfile::tempdir().unwrap();
    let log = synthetic::write_log(&directory.path().join("episode.mcap")).unwrap();
    check_paths("tandem.json", &log);
}

#[test]
fn layouts_show_every_configured_panel_once() {
    ["tandem.json", "bridge.json"].into_iter().for_each(check_panels);
}

fn check_panels(name: &str) {
    let layout = layout(name);
    let mut shown = BTreeSet::new();
    collect_panels(&layout["layout"], &mut shown);
    let configured: BTreeSet<String> =
        layout["configById"].as_object().unwrap().keys().cloned().collect();
    assert_eq!(shown, configured);
    for panel in &shown {
        let (kind, id) = panel.split_once('!').unwrap();
        assert!(!kind.is_empty() && !id.is_empty(), "{panel}");
    }
    for key in ["globalVariables", "userNodes"] {
        assert!(layout[key].is_object(), "{key}");
    }
    assert_eq!(layout["playbackConfig"]["speed"], 1);
}
