//! Changes of a cell file that keep its other keys and its comments.

use toml_edit::{DocumentMut, Item, value};

use crate::cell_file::{ArmTiming, CellFile, CellFileError};

/// Returns the text of a cell file with new times of its arms, in the order of the file. Other keys and comments stay
/// as they are.
///
/// # Errors
/// Returns the first problem of the text or of the new times.
pub fn with_timings(text: &str, timings: &[ArmTiming]) -> Result<String, CellFileError> {
    CellFile::parse(text)?;
    let mut document: DocumentMut = text.parse().map_err(|error: toml_edit::TomlError| {
        let what = error.message().replace('\n', " ");
        CellFileError::Syntax { line: 1, what }
    })?;
    for (idx, timing) in timings.iter().enumerate() {
        let times = [
            ("lag_s", timing.lag_s),
            ("reaction_s", timing.reaction_s),
            ("brake_s", timing.brake_s),
        ];
        for (key, time_s) in times {
            let item = value((time_s * 1e4).round() / 1e4);
            set(&mut document["arms"], idx, key, item);
        }
    }
    let text = document.to_string();
    CellFile::parse(&text)?;
    Ok(text)
}

/// Sets a key of the arm `idx`, whether arms are tables or an array of inline tables.
fn set(arms: &mut Item, idx: usize, key: &str, item: Item) {
    if let Some(table) = arms.as_array_of_tables_mut().and_then(|tables| tables.get_mut(idx)) {
        table[key] = item;
    } else if let Some(table) = arms
        .as_array_mut()
        .and_then(|array| array.get_mut(idx))
        .and_then(toml_edit::Value::as_inline_table_mut)
        && let Ok(value) = item.into_value()
    {
        table.insert(key, value);
    }
}
