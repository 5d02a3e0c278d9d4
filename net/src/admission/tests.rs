use super::*;

const ELSEWHERE: &str = "192.0.2.7";

fn peer(text: &str) -> Option<IpAddr> {
    Some(text.parse().unwrap())
}

fn strangers(admission: &Arc<Admission>, peer: Option<IpAddr>, n: usize) -> Vec<Seat> {
    (0..n).map(|_| admission.admit(peer)).collect()
}

/// Whether each connection may stay.
fn stay(seats: &mut [Seat]) -> Vec<bool> {
    let mut context = Context::from_waker(Waker::noop());
    seats.iter_mut().map(|seat| seat.check(&mut context).is_ok()).collect()
}

#[test]
fn a_process_keeps_files_for_other_things_and_places_for_newcomers() {
    let check = |limit, total, authenticated| {
        let capacity = Capacity::for_open_files(limit);
        assert_eq!((capacity.total, capacity.authenticated), (total, authenticated), "{limit:?}");
    };
    check(Some(0), 2, 1);
    check(Some(8), 6, 5);
    check(Some(256), 192, 168);
    check(Some(1024), 960, 928);
    check(Some(1_048_576), MOST, MOST - RESERVE);
    check(Some(u64::MAX), MOST, MOST - RESERVE);
    check(None, MOST, MOST - RESERVE);
}

#[test]
fn an_address_is_counted_by_host_and_not_at_all_on_loopback() {
    let check = |address: &str, expected: Option<&str>| {
        assert_eq!(counted(address.parse().unwrap()), expected.and_then(peer), "{address}");
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
async fn the_connection_that_has_proven_least_for_longest_makes_room() {
    let admission = Admission::new(Capacity::of(8));
    let mut seats = strangers(&admission, None, 8);
    seats[0].place.authenticated();
    for seat in &seats[1..4] {
        seat.place.requested();
    }
    tokio::time::advance(FRESH).await;
    let evicted_by_newcomers = |seats: &mut Vec<Seat>, n_newcomers| {
        let before = stay(seats);
        let newcomers = strangers(&admission, None, n_newcomers);
        let after = stay(seats);
        seats.extend(newcomers);
        let changed = before.iter().zip(&after).enumerate().filter(|(_, (a, b))| a != b);
        changed.map(|(idx, _)| idx).collect::<Vec<_>>()
    };
    // Those without a request, the oldest first; newcomers are given a second to make one.
    assert_eq!(evicted_by_newcomers(&mut seats, 4), [4, 5, 6, 7]);
    assert_eq!(evicted_by_newcomers(&mut seats, 3), [1, 2, 3]);
    assert_eq!(evicted_by_newcomers(&mut seats, 2), [8, 9]);
    assert!(stay(&mut seats)[0], "an authenticated connection is never evicted");
}

#[tokio::test(start_paused = true)]
async fn authenticated_connections_leave_places_to_newcomers() {
    let admission = Admission::new(Capacity::of(8));
    let mut seats = strangers(&admission, None, 8);
    seats.iter().for_each(|seat| seat.place.authenticated());
    let mut newcomer = admission.admit(None);
    assert_eq!(stay(&mut seats), [true, true, true, true, true, true, true, false]);
    assert_eq!(stay(std::slice::from_mut(&mut newcomer)), [true]);
    // Once one of them has gone, the next call of the newcomer proves it.
    newcomer.place.authenticated();
    assert_eq!(newcomer.place.standing(), Standing::Requested);
    seats.remove(0);
    newcomer.place.authenticated();
    assert_eq!(newcomer.place.standing(), Standing::Authenticated);
}

#[tokio::test(start_paused = true)]
async fn an_address_cannot_take_more_than_half_of_the_places_without_an_authenticated_call() {
    let admission = Admission::new(Capacity::of(8));
    let mut others = strangers(&admission, peer("10.0.0.1"), 2);
    let mut crowd = strangers(&admission, peer(ELSEWHERE), 6);
    assert_eq!(stay(&mut crowd), [false, false, true, true, true, true]);
    assert_eq!(stay(&mut others), [true, true]);
    crowd[2].place.authenticated();
    crowd.push(admission.admit(peer(ELSEWHERE)));
    assert_eq!(stay(&mut crowd), [false, false, true, true, true, true, true]);
    drop(crowd);
    drop(others);
    let book = admission.book();
    assert_eq!((book.n_open, book.n_authenticated, book.evictable.len()), (0, 0, 0));
    assert!(book.per_peer.is_empty(), "{:?}", book.per_peer);
}

#[tokio::test(start_paused = true)]
async fn one_machine_may_have_as_many_workers_as_there_is_room_for() {
    let admission = Admission::new(Capacity::of(4096));
    let mut workers = strangers(&admission, peer("127.0.0.1"), 4000);
    workers.iter().for_each(|seat| seat.place.authenticated());
    assert!(stay(&mut workers).iter().all(|stays| *stays));
}

#[tokio::test(start_paused = true)]
async fn an_evicted_connection_stays_what_it_was() {
    let admission = Admission::new(Capacity::of(2));
    let mut seats = strangers(&admission, None, 3);
    seats[0].place.authenticated();
    assert_eq!(stay(&mut seats), [false, true, true]);
    assert_eq!(admission.book().n_authenticated, 0);
    assert!(admission.poll_room(&Context::from_waker(Waker::noop())).is_pending());
    seats.remove(0);
    assert!(admission.poll_room(&Context::from_waker(Waker::noop())).is_ready());
}
