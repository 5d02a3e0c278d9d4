//! Settings under the keys of earlier versions.

use anyhow::bail;
use tandem_rl::config::former_keys::{ADDED, REMOVED, RENAMED};
use toml::{Table, Value};

use super::{set, shown};

/// Settings that together only a file with all settings has.
const OF_RESOLVED_FILES: [&str; 5] = [
    "rounds.polyak_every",
    "ddpg.n_hidden_layers",
    "evaluation.seed",
    "stop.until_success",
    "checkpoint.keep",
];

/// Gives settings that are missing from a file with all settings of an earlier version the values that were in effect
/// then. Other files leave them to the recipe.
pub(super) fn with_added(mut table: Table) -> anyhow::Result<Table> {
    if OF_RESOLVED_FILES.iter().any(|key| lookup(&table, key).is_none()) {
        return Ok(table);
    }
    for (key, value) in ADDED {
        if lookup(&table, key).is_none() {
            set(&mut table, key, value.parse()?)?;
        }
    }
    Ok(table)
}

/// Moves the values of former keys to the current ones, and drops removed settings.
pub(super) fn current_keys(mut table: Table) -> anyhow::Result<Table> {
    for (former, current) in RENAMED {
        if let Some(value) = take(&mut table, former) {
            if lookup(&table, current).is_some() {
                bail!("{former} is the former name of {current}: give one of them");
            }
            set(&mut table, current, value)?;
        }
    }
    for key in REMOVED {
        if let Some(value) = take(&mut table, key) {
            is_removed(key, &value)?;
        }
    }
    Ok(table)
}

/// Returns true if `key` is a removed setting, whose value must be 0.
pub(super) fn is_removed(key: &str, value: &Value) -> anyhow::Result<bool> {
    if !REMOVED.contains(&key) {
        return Ok(false);
    }
    let number = value.as_float().or(value.as_integer().map(|whole| whole as f64));
    if number != Some(0.0) {
        bail!("{key} is {}: the setting no longer exists, only 0 is accepted", shown(value));
    }
    Ok(true)
}

/// Removes a setting of a section, and returns its value.
fn take(table: &mut Table, key: &str) -> Option<Value> {
    let (section, name) = key.split_once('.')?;
    table.get_mut(section)?.as_table_mut()?.remove(name)
}

/// Returns the value of a setting of a section.
fn lookup<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    let (section, name) = key.split_once('.')?;
    table.get(section)?.get(name)
}
