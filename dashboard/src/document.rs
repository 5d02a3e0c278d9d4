//! JSON documents.

use std::sync::Arc;

use serde::Serialize;

/// A JSON document that pages fetch.
#[derive(Debug, Clone)]
pub(crate) struct Document {
    text: Arc<str>,
    /// The beginning of each row of a growing list in the text. Pages fetch the rows that they lack.
    rows: Option<Arc<[usize]>>,
}

impl Document {
    /// Returns the document of a list that grows at its end.
    pub(crate) fn of_rows<T: Serialize>(rows: &[T]) -> Self {
        let mut text = String::from("[");
        let mut begins = Vec::with_capacity(rows.len());
        for row in rows {
            if !begins.is_empty() {
                text.push(',');
            }
            begins.push(text.len());
            text.push_str(&encode(row));
        }
        text.push(']');
        Self { text: text.into(), rows: Some(begins.into()) }
    }

    /// Returns the whole document, JSON on one line.
    pub(crate) fn text(&self) -> &str {
        &self.text
    }

    /// Returns the list without its first `from` rows, or `None` if the document is no list of rows.
    pub(crate) fn rows_from(&self, from: usize) -> Option<String> {
        let begins = self.rows.as_ref()?;
        Some(match begins.get(from) {
            Some(&begin) => format!("[{}", &self.text[begin..]),
            None => "[]".to_owned(),
        })
    }
}

impl From<Arc<str>> for Document {
    fn from(text: Arc<str>) -> Self {
        Self { text, rows: None }
    }
}

/// Encodes as JSON on one line. Numbers that are not finite become `null`.
pub(crate) fn encode<T: Serialize + ?Sized>(value: &T) -> Arc<str> {
    serde_json::to_string(value).map_or_else(|_unencodable| "null".into(), Into::into)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_sent_from_any_number_on() {
        let rows = Document::of_rows(&["a,b", "[c]", ""]);
        assert_eq!(rows.text(), r#"["a,b","[c]",""]"#);
        let tails = [r#"["a,b","[c]",""]"#, r#"["[c]",""]"#, r#"[""]"#, "[]", "[]"];
        for (from, tail) in tails.into_iter().enumerate() {
            assert_eq!(rows.rows_from(from).as_deref(), Some(tail));
        }
        let none = Document::of_rows::<u32>(&[]);
        assert_eq!((none.text(), none.rows_from(0).as_deref()), ("[]", Some("[]")));
        assert_eq!(Document::from(encode(&[1, 2])).rows_from(1), None);
    }
}
