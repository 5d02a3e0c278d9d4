//! A minimal check of XML.

/// Fails unless every tag is closed by its own, `&` begins an entity, and no number is NaN or infinite.
pub(crate) fn assert_well_formed(xml: &str) {
    let mut open = Vec::new();
    for (position, _) in xml.match_indices('<') {
        let tag =
            &xml[position + 1..position + xml[position..].find('>').expect("an unfinished tag")];
        let name = |tag: &str| tag.split_whitespace().next().unwrap_or_default().to_owned();
        match tag.strip_prefix('/') {
            Some(closed) => assert_eq!(open.pop(), Some(name(closed))),
            None if tag.ends_with('/') || tag.starts_with('!') || tag.starts_with('?') => {}
            None => open.push(name(tag)),
        }
        assert_eq!(tag.matches('"').count() % 2, 0, "{tag}");
    }
    assert!(open.is_empty(), "never closed: {open:?}");
    for (position, _) in xml.match_indices('&') {
        assert!(
            ["&amp;", "&lt;", "&gt;", "&quot;", "&apos;", "&#"]
                .iter()
                .any(|entity| xml[position..].starts_with(entity))
        );
    }
    assert!(
        !xml.contains("NaN") && !xml.contains("inf\"") && !xml.contains("inf "),
        "a number is not finite"
    );
}
