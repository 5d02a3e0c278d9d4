//! A Redis server that is shared, dies, hangs, forgets and wants a password.

use std::cell::RefCell;
use std::io::Write;
use std::sync::{Arc, Mutex, Once};
use std::thread;
use std::time::Duration;

use tandem_teacher::ledger::{Ledger as _, LedgerError, RedisLedger};

use crate::ledger_tests::fixture::{BOTH, FIRST, NEITHER, NOTHING, charge, request, terms};
use crate::ledger_tests::redis_server::RedisServer;

fn is_unavailable<T: std::fmt::Debug>(outcome: Result<T, LedgerError>) -> String {
    match outcome {
        Err(error @ LedgerError::Unavailable { .. }) => error.to_string(),
        other => panic!("expected unavailable, got {other:?}"),
    }
}

#[test]
fn teachers_share_an_account_and_never_overspend_it() {
    let Some(server) = RedisServer::start() else { return };
    let budget = 2_000;
    let play = |number: u64| {
        let url = server.url();
        move || {
            let mut ledger = RedisLedger::open(&url).expect("a ledger");
            ledger.open("run", terms(budget)).expect("an account");
            let mut charged = Vec::new();
            for step in 0..400 {
                // Episodes of its own, one that all threads use, and sometimes a round of leases.
                let charges = [
                    charge(number, step, BOTH),
                    charge(100, step, BOTH),
                    charge(200 + number, step % 50, BOTH),
                ];
                if step == 100 {
                    ledger.open_leases("run", &[200 + number], 30).expect("leases");
                }
                if step == 300 {
                    ledger.settle("run", &[200 + number]).expect("settled");
                }
                let result = ledger.charge(&[request("run", &charges)]).remove(0).expect("paid");
                let steps = charges.map(|charge| (charge.episode, charge.step));
                charged.extend(steps.into_iter().zip(result.verdicts));
            }
            charged
        }
    };
    let threads: Vec<_> = (0..4).map(|number| thread::spawn(play(number))).collect();
    let mut verdicts = std::collections::BTreeMap::new();
    for thread in threads {
        for (step, verdict) in thread.join().expect("played") {
            assert_eq!(*verdicts.entry(step).or_insert(verdict), verdict, "{step:?}");
        }
    }
    let n_charged = verdicts.values().filter(|verdict| **verdict != NOTHING).count();
    let mut ledger = RedisLedger::open(&server.url()).expect("a ledger");
    let balance = ledger.balance("run").expect("an account");
    assert_eq!((balance.spent, balance.leased, balance.left), (budget, 0, 0));
    assert_eq!(u64::try_from(n_charged).expect("few"), budget);
}

#[test]
fn a_killed_server_is_unavailable_and_comes_back_with_everything() {
    let Some(mut server) =
        RedisServer::start_with(&["--appendonly", "yes", "--appendfsync", "always"])
    else {
        return;
    };
    let mut ledger = RedisLedger::open(&server.url()).expect("a ledger");
    ledger.open("run", terms(10)).expect("an account");
    ledger.open_leases("run", &[1], 3).expect("leases");
    let charges = request("run", &[charge(1, 0, BOTH), charge(2, 0, NEITHER), charge(2, 1, BOTH)]);
    let result = ledger.charge(std::slice::from_ref(&charges)).remove(0).expect("paid");
    server.kill();
    let message = is_unavailable(ledger.balance("run"));
    assert!(
        message
            .starts_with(&format!("the ledger cannot be used now: cannot use {}: ", server.url())),
        "{message}"
    );
    is_unavailable(ledger.open("run", terms(10)));
    is_unavailable(ledger.open_leases("run", &[1], 3));
    is_unavailable(ledger.settle("run", &[1]));
    let outcomes = ledger.charge(&[charges.clone(), charges.clone()]);
    outcomes.into_iter().for_each(|outcome| drop(is_unavailable(outcome)));
    server.restart();
    // The same ledger reconnects, and the charges are kept.
    let again = ledger.charge(std::slice::from_ref(&charges)).remove(0).expect("paid");
    assert_eq!((again.verdicts, again.left), (result.verdicts, result.left));
    assert_eq!(again.repeated, [true; 3]);
    let balance = ledger.settle("run", &[1]).expect("settled");
    assert_eq!((balance.spent, balance.leased, balance.left), (2, 0, 8));
}

/// A restart of the server, or the loss of its scripts, between two calls has no effect on them.
#[test]
fn a_broken_connection_and_forgotten_scripts_are_mended_unseen() {
    let Some(mut server) = RedisServer::start() else { return };
    let mut ledger = RedisLedger::open(&server.url()).expect("a ledger");
    ledger.open("run", terms(10)).expect("an account");
    let flush =
        || redis::cmd("SCRIPT").arg("FLUSH").exec(&mut server.connection()).expect("flushed");
    flush();
    let charges = [request("run", &[charge(1, 0, BOTH)]), request("run", &[charge(1, 1, BOTH)])];
    let outcomes = ledger.charge(&charges);
    assert!(outcomes.iter().all(|outcome| outcome.as_ref().is_ok_and(|r| r.verdicts == [FIRST])));
    assert_eq!(ledger.balance("run").expect("known").spent, 2);
    server.kill();
    server.restart();
    assert!(ledger.balance("run").is_ok());
}

#[test]
fn a_server_that_hangs_is_unavailable_within_seconds() {
    let Some(server) = RedisServer::start() else { return };
    let mut ledger = RedisLedger::open(&server.url()).expect("a ledger");
    ledger.open("run", terms(10)).expect("an account");
    let charges = [request("run", &[charge(1, 0, BOTH)]), request("run", &[charge(1, 1, BOTH)])];
    let mut connection = server.connection();
    let before = n_connections(&mut connection);
    server.signal("-STOP");
    ledger.charge(&charges).into_iter().for_each(|outcome| drop(is_unavailable(outcome)));
    server.signal("-CONT");
    assert_eq!(n_connections(&mut connection), before, "a call that timed out is not repeated");
    server.signal("-STOP");
    is_unavailable(ledger.balance("run"));
    server.signal("-CONT");
    // The charges may have been made before the replies were lost. No late reply is taken for that to another call.
    let again = ledger.charge(&charges).pop().expect("an outcome").expect("paid");
    assert_eq!((again.verdicts.as_slice(), again.left), ([FIRST].as_slice(), 8));
}

/// Returns the number of connections that the server has accepted since it started.
fn n_connections(connection: &mut redis::Connection) -> u64 {
    let stats: String = redis::cmd("INFO").arg("stats").query(connection).expect("an answer");
    let count = stats.lines().find_map(|line| line.strip_prefix("total_connections_received:"));
    count.and_then(|count| count.trim().parse().ok()).expect("a count")
}

#[test]
fn a_password_is_used_and_never_shown() {
    let Some(server) =
        RedisServer::start_with(&["--appendonly", "yes", "--requirepass", "hunter2"])
    else {
        return;
    };
    let at = |userinfo: &str| format!("redis://{userinfo}127.0.0.1:{}/3", server.port());
    let log = Log::default();
    let refused = log.of(|| RedisLedger::open(&at(":hunter3@")).expect_err("wrong password"));
    let message = format!("{refused}: {}", std::error::Error::source(&refused).expect("why"));
    assert!(message.starts_with(&format!("cannot use the ledger {}: ", at(""))), "{message}");
    assert!(
        !message.contains("hunter") && !format!("{refused:?}").contains("hunter"),
        "{refused:?}"
    );
    assert!(RedisLedger::open(&at("")).is_err(), "no password");
    let mut ledger = log.of(|| RedisLedger::open(&at(":hunter2@")).expect("let in"));
    ledger.open("run", terms(10)).expect("an account");
    assert!(format!("{ledger:?}").contains(&at("")), "the address is shown: {ledger:?}");
    assert!(!format!("{ledger:?}").contains("hunter"), "{ledger:?}");
    let logged = log.text();
    assert!(logged.contains("ledger opened") && !logged.contains("hunter"), "{logged}");
}

#[test]
fn a_server_that_may_forget_is_warned_about() {
    let careless =
        ["--appendonly", "no", "--maxmemory", "50mb", "--maxmemory-policy", "allkeys-lru"];
    let Some(server) = RedisServer::start_with(&careless) else { return };
    let log = Log::default();
    let mut ledger = log.of(|| RedisLedger::open(&server.url()).expect("a ledger"));
    let logged = log.text();
    assert!(logged.contains("append-only file") && logged.contains("noeviction"), "{logged}");
    ledger.open("run", terms(10)).expect("an account");
    ledger.open("walk", terms(10)).expect("an account");

    // The server evicts keys only with a memory limit and a policy that evicts.
    let careful: [&[&str]; 3] = [
        &["--appendonly", "yes"],
        &["--appendonly", "yes", "--maxmemory-policy", "allkeys-lru"],
        &["--appendonly", "yes", "--maxmemory", "50mb", "--maxmemory-policy", "noeviction"],
    ];
    for settings in careful {
        let Some(careful) = RedisServer::start_with(settings) else { return };
        let log = Log::default();
        drop(log.of(|| RedisLedger::open(&careful.url())));
        assert!(!log.text().contains("WARN"), "{settings:?}: {}", log.text());
    }
    let log = Log::default();
    drop(log.of(|| RedisLedger::open(&server.url())));
    assert!(log.text().contains("accounts=2"), "{}", log.text());
}

#[test]
fn a_server_that_refuses_writes_is_warned_about_until_it_accepts_them() {
    let Some(server) = RedisServer::start() else { return };
    let mut ledger = RedisLedger::open(&server.url()).expect("a ledger");
    ledger.open("run", terms(10)).expect("an account");
    let known = [request("run", &[charge(1, 0, BOTH)])];
    ledger.charge(&known).remove(0).expect("paid");
    assert_eq!(ledger.warning(), None);
    let limit_memory = |bytes: u64| {
        let mut command = redis::cmd("CONFIG");
        command.arg("SET").arg("maxmemory").arg(bytes);
        command.exec(&mut server.connection()).expect("set");
    };

    limit_memory(1);
    let log = Log::default();
    let new = [request("run", &[charge(1, 1, BOTH)])];
    is_unavailable(log.of(|| ledger.charge(&new).remove(0)));
    let expected = format!("cannot write {}: ", server.url());
    let warning = ledger.warning().expect("a warning").to_owned();
    assert!(warning.starts_with(&expected) && warning.contains("maxmemory"), "{warning}");
    assert!(log.text().contains(&warning), "{}", log.text());
    // What needs no memory succeeds and proves nothing.
    assert_eq!(ledger.balance("run").expect("an account").spent, 1);
    assert!(ledger.charge(&known).remove(0).is_ok());
    assert_eq!(ledger.warning(), Some(warning.as_str()));

    limit_memory(0);
    ledger.charge(&new).remove(0).expect("paid");
    assert_eq!(ledger.warning(), None);
    limit_memory(1);
    is_unavailable(ledger.open_leases("run", &[2], 3));
    assert!(ledger.warning().is_some());
    limit_memory(0);
    ledger.open_leases("run", &[2], 3).expect("leases");
    assert_eq!(ledger.warning(), None);
}

#[test]
fn the_keys_of_an_account_have_one_hash_tag_and_can_be_read() {
    let Some(server) = RedisServer::start() else { return };
    let mut ledger = RedisLedger::open(&server.url()).expect("a ledger");
    for name in ["run", "}"] {
        ledger.open(name, terms(10)).expect("an account");
        ledger.open_leases(name, &[u64::MAX], 3).expect("leases");
        let charges =
            [charge(u64::MAX, 2, BOTH), charge(u64::MAX, 4, NEITHER), charge(9, 64, BOTH)];
        ledger.charge(&[request(name, &charges)]).remove(0).expect("paid");
    }
    let mut connection = server.connection();
    let mut text = |command: &str, key: &str, field: &str| -> String {
        redis::cmd(command).arg(key).arg(field).query(&mut connection).expect(key)
    };
    for name in ["run", "}"] {
        let key = |kind: &str| format!("{{tandem:{name}}}:{kind}");
        assert_eq!(text("HGET", &key("account"), "spent"), "2");
        assert_eq!(text("HGET", &key("account"), "leased"), "2");
        assert_eq!(text("HGET", &key("leases"), "18446744073709551615"), "3 3 1 0");
        assert_eq!(text("HGET", &key("verdicts"), "18446744073709551615:0"), "--1-0");
        assert_eq!(text("HGET", &key("verdicts"), "9:1"), "1");
    }
}

/// The log lines of one thread.
#[derive(Clone, Default)]
pub(crate) struct Log(Arc<Mutex<Vec<u8>>>);

thread_local! {
    /// The log of this thread, if it collects one.
    static CURRENT: RefCell<Option<Log>> = const { RefCell::new(None) };
}

impl Log {
    /// Runs `call` and collects its log lines. All threads share one subscriber: with one for each, an event that first
    /// occurs in a thread without a subscriber may be cached as disabled for all.
    pub(crate) fn of<T>(&self, call: impl FnOnce() -> T) -> T {
        static SUBSCRIBED: Once = Once::new();
        SUBSCRIBED.call_once(|| {
            let writer = || CURRENT.with_borrow(|log| log.clone().unwrap_or_default());
            tracing_subscriber::fmt().with_ansi(false).with_writer(writer).init();
        });
        CURRENT.replace(Some(self.clone()));
        let outcome = call();
        CURRENT.replace(None);
        outcome
    }

    pub(crate) fn text(&self) -> String {
        String::from_utf8(self.0.lock().expect("whole").clone()).expect("UTF-8")
    }
}

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().expect("whole").write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Opening a connection to a server that accepts and never answers times out.
#[test]
fn a_silent_server_times_out() {
    let silent = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let url = format!("redis://{}", silent.local_addr().expect("an address"));
    let (send, receive) = std::sync::mpsc::sync_channel(1);
    let open = move || send.send(RedisLedger::open(&url).map(drop)).expect("received");
    let opening = thread::spawn(open);
    let outcome = receive.recv_timeout(Duration::from_secs(60)).expect("it times out");
    assert!(outcome.is_err());
    opening.join().expect("ended");
}
