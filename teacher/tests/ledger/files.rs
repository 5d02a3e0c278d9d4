//! The file of a ledger: opening, refusals, and its tables as seen by other tools.

use std::fs;
use std::path::{Path, PathBuf};

use rusqlite::Connection;
use tandem_teacher::ledger::{self, Ledger as _, OpenError, SqliteLedger};
use tempfile::TempDir;

use crate::ledger_tests::fixture::{BOTH, charge, request, terms};

fn directory() -> (TempDir, PathBuf) {
    let directory = tempfile::tempdir().expect("a directory");
    let path = directory.path().join("ledger.sqlite");
    (directory, path)
}

/// Creates and closes a ledger with some hundred episodes.
fn filled(path: &Path) {
    let mut ledger = SqliteLedger::open(path).expect("a ledger");
    ledger.open("run", terms(10_000)).expect("an account");
    let episodes: Vec<u64> = (0..600).collect();
    ledger.open_leases("run", &episodes, 10).expect("leases");
    let charges: Vec<_> = episodes.iter().map(|episode| charge(*episode, 7, BOTH)).collect();
    ledger.charge(&[request("run", &charges)]).remove(0).expect("paid");
}

/// Checks that opening fails and leaves the file unchanged. Returns the message, with `FILE` for the path.
fn refusal(path: &Path) -> String {
    let before = fs::read(path).ok();
    let error = SqliteLedger::open(path).expect_err("refused");
    assert_eq!(fs::read(path).ok(), before, "{error}");
    let message = error.to_string();
    assert!(!message.contains('\n'), "{message}");
    message.replace(&format!("{:?}", path.display().to_string()), "FILE")
}

#[test]
fn a_file_that_is_not_a_ledger_is_refused_and_unchanged() {
    let check = |bytes: &[u8]| {
        let (_directory, path) = directory();
        fs::write(&path, bytes).expect("written");
        assert_eq!(
            refusal(&path),
            "FILE is no ledger but something that is not an SQLite database: move it away or name another file"
        );
    };
    check(b"a shopping list\n");
    check(&[0x53; 10_000]);
    check(b"SQLite format 3");

    let (_directory, path) = directory();
    let other = Connection::open(&path).expect("a database");
    other.execute_batch("CREATE TABLE accounts (id, name)").expect("a table");
    drop(other);
    assert_eq!(
        refusal(&path),
        "FILE is no ledger but an SQLite database of another program: move it away or name another file"
    );
}

#[test]
fn a_newer_version_is_refused_by_its_number() {
    let (_directory, path) = directory();
    filled(&path);
    let other = Connection::open(&path).expect("a database");
    other.pragma_update(None, "user_version", 3).expect("another version");
    drop(other);
    let message = refusal(&path);
    assert!(
        message.starts_with("the ledger FILE has version 3, this program reads versions 1 to 2: "),
        "{message}"
    );
}

#[test]
fn a_damaged_file_is_refused() {
    let damage = |change: &dyn Fn(&mut Vec<u8>)| {
        let (_directory, path) = directory();
        filled(&path);
        let mut bytes = fs::read(&path).expect("bytes");
        change(&mut bytes);
        fs::write(&path, bytes).expect("written");
        let message = refusal(&path);
        assert!(message.starts_with("the ledger FILE is damaged ("), "{message}");
        assert!(
            message
                .ends_with("): put a copy in its place, or move it away to begin with no accounts"),
            "{message}"
        );
    };
    damage(&|bytes| bytes.truncate(bytes.len() / 2));
    damage(&|bytes| bytes.truncate(5_000));
    damage(&|bytes| {
        let from = bytes.len() / 2;
        bytes[from..from + 4096].fill(0xA5);
    });
    damage(&|bytes| {
        let from = bytes.len() - 4096;
        bytes[from..].fill(0);
    });
}

#[test]
fn tables_that_contradict_one_another_are_damage() {
    let check = |sql: &str, expected: &str| {
        let (_directory, path) = directory();
        filled(&path);
        let other = Connection::open(&path).expect("a database");
        other.execute_batch(sql).expect(sql);
        drop(other);
        let message = refusal(&path);
        assert!(message.contains(expected), "{sql}: {message}");
    };
    check("UPDATE accounts SET spent = 599", "account \"run\" has spent 599, its verdicts say 600");
    check("UPDATE accounts SET budget = 599", "more than the budget is handed out");
    check("UPDATE accounts SET budget = -1", "is damaged");
    check("UPDATE accounts SET strategy = 'often'", "often");
    check(
        "UPDATE verdicts SET asked = 0 WHERE episode = 5",
        "the verdicts on episode 5 contradict one another",
    );
    check("DELETE FROM verdicts WHERE episode = 5", "its verdicts say 599");
    check(
        "UPDATE leases SET units = 0, early_units = 0 WHERE episode = 5",
        "the lease of episode 5 does not fit",
    );
    check("UPDATE leases SET units = 1 << 40 WHERE episode = 5", "is damaged");
    check("PRAGMA foreign_keys = OFF; DELETE FROM accounts", "there is no account 1");
    check("DROP TABLE leases", "no such table: leases");
}

#[test]
fn the_checksum_detects_changes_that_contradict_no_other_row() {
    let check = |sql: &str| {
        let (_directory, path) = directory();
        filled(&path);
        let other = Connection::open(&path).expect("a database");
        other.execute_batch(sql).expect(sql);
        drop(other);
        let message = refusal(&path);
        let expected = "account \"run\": its rows do not match its checksum";
        assert!(message.contains(expected), "{sql}: {message}");
    };
    check("UPDATE accounts SET budget = 10001");
    check("UPDATE accounts SET strategy = 'ea'");
    check("UPDATE accounts SET checksum = checksum + 1");
    check("UPDATE verdicts SET asked = asked | 256 WHERE episode = 5");
    check("UPDATE verdicts SET first_half = 0 WHERE episode = 5");
    check("UPDATE verdicts SET word = 1 WHERE episode = 5");
    check("INSERT INTO verdicts VALUES (1, 601, 0, 1, 0, 0)");
    check("UPDATE leases SET settled = 1 WHERE episode = 5");
    check("UPDATE leases SET early_units = 9 WHERE episode = 5");
    check("DELETE FROM leases WHERE episode = 5");
    check(
        "PRAGMA foreign_keys = OFF; UPDATE verdicts SET episode = 700 WHERE episode = 5;
        UPDATE leases SET episode = 700 WHERE episode = 5",
    );
}

/// Bytes of a damaged file must not reach a terminal unescaped, nor split the line.
#[test]
fn a_refusal_has_no_control_characters_of_the_file() {
    let check = |sql: &str, expected: &str| {
        let (_directory, path) = directory();
        filled(&path);
        let other = Connection::open(&path).expect("a database");
        other.execute_batch(sql).expect(sql);
        drop(other);
        let message = refusal(&path);
        assert!(
            message.contains(expected) && !message.contains(char::is_control),
            "{sql}: {message:?}"
        );
    };
    check(
        "UPDATE accounts SET name = 'a' || char(27) || '[31m' || char(10, 13, 133, 8238), spent = 1",
        "account \"a\\u{1b}[31m\\n\\r\\u{85}\\u{202e}\" has spent 1",
    );
    check("UPDATE accounts SET strategy = char(27, 10)", "\\u{1b}\\n");
    check(
        "PRAGMA writable_schema = ON; UPDATE sqlite_schema SET sql = 'CREATE ' || char(27, 10)",
        "malformed database schema",
    );
}

#[test]
fn a_path_that_cannot_hold_a_file_is_refused() {
    let (directory, path) = directory();
    let check = |path: &Path, expected: &str| {
        let error = SqliteLedger::open(path).expect_err("refused");
        assert!(matches!(error, OpenError::BadPath { .. }), "{error}");
        assert_eq!(error.to_string(), format!("cannot keep a ledger at {path:?}: {expected}"));
    };
    check(directory.path(), "it is a directory");
    check(Path::new("/dev/null"), "it is not a regular file");
    check(&path.join("below"), &format!("there is no directory {path:?}"));
    fs::write(&path, b"").expect("written");
    check(&path.join("below"), &format!("there is no directory {path:?}"));
    let twin = directory.path().join("twin.sqlite");
    fs::hard_link(&path, &twin).expect("a link");
    check(&twin, "the file has 2 names (hard links), keep only one of them");
    let dangling = directory.path().join("dangling.sqlite");
    std::os::unix::fs::symlink(directory.path().join("missing/ledger"), &dangling).expect("a link");
    check(&dangling, "No such file or directory (os error 2)");
    let long = directory.path().join("a".repeat(300));
    check(&long, "File name too long (os error 36)");
    assert_eq!(fs::read(&path).expect("bytes"), b"");
}

#[test]
fn a_ledger_that_cannot_be_opened_now_is_not_called_damaged() {
    let (_directory, path) = directory();
    filled(&path);
    let log = path.with_file_name("ledger.sqlite-wal");
    fs::create_dir(&log).expect("something in the place of the log");
    let error = SqliteLedger::open(&path).expect_err("refused");
    assert!(matches!(error, OpenError::Io { .. }), "{error}");
    fs::remove_dir(&log).expect("removed");
    assert_eq!(
        SqliteLedger::open(&path).expect("a ledger").balance("run").expect("kept").spent,
        600
    );
}

#[test]
fn an_empty_file_becomes_a_ledger() {
    let (_directory, path) = directory();
    fs::write(&path, b"").expect("written");
    SqliteLedger::open(&path).expect("a ledger").open("run", terms(3)).expect("an account");
    assert_eq!(SqliteLedger::open(&path).expect("a ledger").balance("run").expect("kept").left, 3);
}

#[test]
fn an_invalid_location_is_refused() {
    let check = |place: &str, expected: &str| {
        let error = ledger::open(place).err().expect(place);
        assert!(matches!(error, OpenError::InvalidLocation(_)), "{place}: {error}");
        let message = error.to_string();
        assert!(message.contains(expected) && !message.contains("hunter2"), "{place}: {message}");
        assert!(message.starts_with("expected memory, redis://"), "{place}: {message}");
    };
    check("", "the name is empty");
    check("postgres://user:hunter2@host/db", "there is no ledger of the kind \"postgres\"");
    check("rediss://user:hunter2@host/0", "through a tunnel");
    check("redis://", "the redis:// URL");
    check("redis://user:hunter2@host:port/0", "the redis:// URL cannot be read");
    check("redis://user:hunter2@host/zero", "Invalid database number");
    check("redis://user:hunter2#@host/0", "the redis:// URL");
    check(
        "redis://user:hunter2@host/0?protocol=resp3",
        "which must be written as %3F or %23 in a password",
    );
}

/// The `sqlite3` tool reads the same.
#[test]
fn the_tables_list_the_charges() {
    let (_directory, path) = directory();
    let mut ledger = SqliteLedger::open(&path).expect("a ledger");
    ledger.open("run", terms(5)).expect("an account");
    ledger.open_leases("run", &[3], 2).expect("leases");
    let charges = [
        charge(3, 0, BOTH),
        charge(3, 49, BOTH),
        charge(3, 20, BOTH),
        charge(u64::MAX, 63, BOTH),
        charge(u64::MAX, 129, BOTH),
    ];
    ledger.charge(&[request("run", &charges)]).remove(0).expect("paid");
    ledger.settle("run", &[3]).expect("settled");
    // While the ledger is open, too.
    let reader = Connection::open(&path).expect("a database");
    let text = |sql: &str| -> Vec<String> {
        let mut statement = reader.prepare(sql).expect(sql);
        statement.query_map((), |row| row.get(0)).expect(sql).collect::<Result<_, _>>().expect(sql)
    };
    let sql =
        "SELECT account || ' ' || episode || ' ' || step || ' ' || half FROM charges ORDER BY 1";
    let expected = [
        "run 18446744073709551615 129 second",
        "run 18446744073709551615 63 first",
        "run 3 0 first",
        "run 3 49 first",
    ];
    assert_eq!(text(sql), expected);
    let sql = "SELECT name || ' ' || budget || ' ' || strategy || ' ' || spent FROM accounts";
    assert_eq!(text(sql), ["run 5 eamc:0.1 4"]);
    let sql = "SELECT episode || ' ' || units || ' ' || early_units || ' ' || settled FROM leases";
    assert_eq!(text(sql), ["3 2 2 1"]);
}
