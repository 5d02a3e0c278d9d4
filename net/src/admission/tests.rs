use super::*;

const OTHER_HOST: &str = "192.0.2.7";

fn peer(text: &str) -> Option<IpAddr> {
    Some(text.parse().unwrap())
}

fn admit_all(admission: &Arc<Admission>, peer: Option<IpAddr>, n: usize) -> Vec<AdmissionPermit> {
    (0..n).map(|_| admission.admit(peer)).collect()
}

/// Returns for each connection whether it may stay open.
fn stay(permits: &mut [AdmissionPermit]) -> Vec<bool> {
    let mut context = Context::from_waker(Waker::noop());
    permits.iter_mut().map(|permit| permit.check(&mut context).is_ok()).collect()
}

#[test]
fn the_capacity_reserves_files_and_unauthenticated_connections() {
    let check = |limit, total, authenticated| {
        let capacity = Capacity::for_open_files(limit);
        assert_eq!((capacity.total, capacity.authenticated), (total, authenticated), "{limit:?}");
    };
    check(Some(0), 2, 1);
    check(Some(8), 4, 3);
    check(Some(256), 144, 126);
    check(Some(1024), 816, 784);
    check(Some(1_048_576), MOST, MOST - RESERVE);
    check(Some(u64::MAX), MOST, MOST - RESERVE);
    check(None, MOST, MOST - RESERVE);
}

#[test]
fn all_connections_of_a_process_leave_it_files_of_its_own() {
    let check = |limit: usize, of_dashboard| {
        let files = u64::try_from(limit).ok();
        let dashboard = Capacity::of_dashboard(files).total;
        assert_eq!(dashboard, of_dashboard, "{limit}");
        let service = Capacity::for_open_files(files).total;
        let n_files = service + dashboard + MOST_OF_TEXT + OTHER_FILES;
        assert!(n_files <= limit, "{n_files} of {limit}");
    };
    check(256, 32);
    check(1024, 128);
    check(65_536, 256);
}

#[test]
fn connections_are_counted_by_host_and_not_at_all_on_loopback() {
    let check = |address: &str, expected: Option<&str>| {
        assert_eq!(counting_key(address.parse().unwrap()), expected.and_then(peer), "{address}");
    };
    check("127.0.0.1", None);
    check("127.8.8.8", None);
    check("::1", None);
    check("::ffff:127.0.0.1", None);
    check("10.0.0.1", Some("10.0.0.1"));
    check("::ffff:10.0.0.1", Some("10.0.0.1"));
    check("2001:db8:1:2:3:4:5:6", Some("2001:db8:1:2::"));
}

#[tokio::test(start_paused = true)]
async fn the_oldest_of_the_least_trusted_connections_is_evicted() {
    let admission = Admission::new(Capacity::of(8));
    let mut permits = admit_all(&admission, None, 8);
    permits[0].handle.mark_authenticated();
    for permit in &permits[1..4] {
        permit.handle.mark_requested();
    }
    tokio::time::advance(FRESH).await;
    let evicted_by_newcomers = |permits: &mut Vec<AdmissionPermit>, n_newcomers| {
        let before = stay(permits);
        let newcomers = admit_all(&admission, None, n_newcomers);
        let after = stay(permits);
        permits.extend(newcomers);
        let changed = before.iter().zip(&after).enumerate().filter(|(_, (a, b))| a != b);
        changed.map(|(idx, _)| idx).collect::<Vec<_>>()
    };
    // Connections without a request are evicted first, the oldest before the others, unless they are younger than 1 s.
    assert_eq!(evicted_by_newcomers(&mut permits, 4), [4, 5, 6, 7]);
    assert_eq!(evicted_by_newcomers(&mut permits, 3), [1, 2, 3]);
    assert_eq!(evicted_by_newcomers(&mut permits, 2), [8, 9]);
    assert!(stay(&mut permits)[0], "an authenticated connection is never evicted");
}

#[tokio::test(start_paused = true)]
async fn a_reserve_is_kept_from_authenticated_connections() {
    let admission = Admission::new(Capacity::of(8));
    let mut permits = admit_all(&admission, None, 8);
    permits.iter().for_each(|permit| permit.handle.mark_authenticated());
    let mut newcomer = admission.admit(None);
    assert_eq!(stay(&mut permits), [true, true, true, true, true, true, true, false]);
    assert_eq!(stay(std::slice::from_mut(&mut newcomer)), [true]);
    // Once one of them has closed, the next call of the new connection authenticates it.
    newcomer.handle.mark_authenticated();
    assert_eq!(newcomer.handle.trust(), Trust::Requested);
    permits.remove(0);
    newcomer.handle.mark_authenticated();
    assert_eq!(newcomer.handle.trust(), Trust::Authenticated);
}

#[tokio::test(start_paused = true)]
async fn one_address_has_at_most_half_of_the_connections_without_an_authenticated_call() {
    let admission = Admission::new(Capacity::of(8));
    let mut others = admit_all(&admission, peer("10.0.0.1"), 2);
    let mut crowd = admit_all(&admission, peer(OTHER_HOST), 6);
    assert_eq!(stay(&mut crowd), [false, false, true, true, true, true]);
    assert_eq!(stay(&mut others), [true, true]);
    crowd[2].handle.mark_authenticated();
    crowd.push(admission.admit(peer(OTHER_HOST)));
    assert_eq!(stay(&mut crowd), [false, false, true, true, true, true, true]);
    drop(crowd);
    drop(others);
    let registry = admission.registry();
    assert_eq!((registry.n_open, registry.n_authenticated, registry.evictable.len()), (0, 0, 0));
    assert!(registry.per_peer.is_empty(), "{:?}", registry.per_peer);
}

#[tokio::test(start_paused = true)]
async fn authenticated_connections_of_one_machine_are_limited_by_the_capacity_alone() {
    let admission = Admission::new(Capacity::of(4096));
    let mut workers = admit_all(&admission, peer("127.0.0.1"), 4000);
    workers.iter().for_each(|permit| permit.handle.mark_authenticated());
    assert!(stay(&mut workers).iter().all(|stays| *stays));
}

#[tokio::test(start_paused = true)]
async fn an_evicted_connection_cannot_be_promoted() {
    let admission = Admission::new(Capacity::of(2));
    let mut permits = admit_all(&admission, None, 3);
    permits[0].handle.mark_authenticated();
    assert_eq!(stay(&mut permits), [false, true, true]);
    assert_eq!(admission.registry().n_authenticated, 0);
    assert!(admission.poll_room(&Context::from_waker(Waker::noop())).is_pending());
    permits.remove(0);
    assert!(admission.poll_room(&Context::from_waker(Waker::noop())).is_ready());
}
