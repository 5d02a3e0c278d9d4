//! Which connections a service keeps: how many it admits, and which of them it drops to admit a newcomer.
//!
//! A newcomer is always admitted. When there is no room for it, the connection that has proven least is evicted: first
//! one that has not made a request in a while, then one that has made no authenticated call, the oldest first. An
//! authenticated connection is never evicted, and some places are never given to authenticated connections. So a
//! caller who can authenticate gets through whatever others hold open.

use std::collections::BTreeMap;
use std::future::Future as _;
use std::io;
use std::net::{IpAddr, Ipv6Addr};
use std::pin::Pin;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::{Instant, Sleep};

use crate::throttle::Throttle;

/// The time until a connection must have made its first request, the TLS handshake included.
pub(crate) const FIRST_REQUEST: Duration = Duration::from_secs(10);
/// The time for which a connection without a request is not the first to be evicted.
const FRESH: Duration = Duration::from_secs(1);
/// The time between two log lines about evictions.
const LOG_EVERY: Duration = Duration::from_secs(60);

/// The most connections of a service that has as many open files as it likes.
const MOST: usize = 16_384;
/// Open files that a service needs beside its connections: its ledger or run directory, logs, other connections.
const OTHER_FILES: usize = 64;
/// Places that authenticated connections cannot take.
const RESERVE: usize = 32;

/// How many connections a service keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Capacity {
    /// All connections.
    total: usize,
    /// Authenticated connections.
    authenticated: usize,
    /// Connections of one address that have made no authenticated call. Loopback addresses have no such limit.
    unauthenticated_per_peer: usize,
}

impl Capacity {
    /// Returns the capacity of a service with `total` connections, at least 2.
    #[must_use]
    pub fn of(total: usize) -> Self {
        let total = total.clamp(2, MOST);
        let reserve = (total / 8).clamp(1, RESERVE);
        Self { total, authenticated: total - reserve, unauthenticated_per_peer: total / 2 }
    }

    /// Returns the capacity of a process that may have `limit` open files; `None` means any number.
    #[must_use]
    pub fn for_open_files(limit: Option<u64>) -> Self {
        let limit = limit.and_then(|limit| usize::try_from(limit).ok()).unwrap_or(usize::MAX);
        Self::of(limit - OTHER_FILES.min(limit / 4))
    }
}

impl Default for Capacity {
    fn default() -> Self {
        Self::of(MOST)
    }
}

/// What a connection has proven, least first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
enum Standing {
    /// No request has come.
    Unproven,
    /// A request has come that needed no token, or had a wrong one, or there is no room for an authenticated one.
    Requested,
    /// A call has passed the guard.
    Authenticated,
}

/// The connections of one service.
#[derive(Debug)]
pub(crate) struct Admission {
    capacity: Capacity,
    book: Mutex<Book>,
}

#[derive(Debug, Default)]
struct Book {
    next_id: u64,
    /// Connections that can be evicted, by standing and age.
    evictable: BTreeMap<(Standing, u64), Evictable>,
    /// The number of evictable connections of each address.
    per_peer: BTreeMap<IpAddr, usize>,
    n_authenticated: usize,
    /// Connections that hold a file, those being evicted included.
    n_open: usize,
    /// Woken when a connection has closed.
    waiting: Option<Waker>,
    log: Throttle,
}

#[derive(Debug)]
struct Evictable {
    peer: Option<IpAddr>,
    since: Instant,
    evict: oneshot::Sender<()>,
}

impl Admission {
    pub(crate) fn new(capacity: Capacity) -> Arc<Self> {
        Arc::new(Self { capacity, book: Mutex::default() })
    }

    fn book(&self) -> MutexGuard<'_, Book> {
        self.book.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The number of open connections.
    pub(crate) fn n_open(&self) -> usize {
        self.book().n_open
    }

    /// Waits until evicted connections have closed: until then there are more than the capacity allows.
    pub(crate) fn poll_room(&self, context: &Context<'_>) -> Poll<()> {
        let mut book = self.book();
        if book.n_open <= self.capacity.total {
            return Poll::Ready(());
        }
        book.waiting = Some(context.waker().clone());
        Poll::Pending
    }

    /// Admits a connection from `peer`, evicting another one where that is needed.
    pub(crate) fn admit(self: &Arc<Self>, peer: Option<IpAddr>) -> Seat {
        let now = Instant::now();
        let peer = peer.and_then(counted);
        let mut book = self.book();
        let of_peer = peer.and_then(|peer| book.per_peer.get(&peer)).copied().unwrap_or_default();
        let evicts = if of_peer >= self.capacity.unauthenticated_per_peer {
            book.evict(peer, now)
        } else if book.n_open >= self.capacity.total {
            book.evict(None, now)
        } else {
            false
        };
        let logged = if evicts { book.log.pass(now, LOG_EVERY) } else { None };
        let (evict, evicted) = oneshot::channel();
        let id = book.next_id;
        book.next_id += 1;
        book.n_open += 1;
        book.add((Standing::Unproven, id), Evictable { peer, since: now, evict });
        let n_open = book.n_open;
        drop(book);
        if let Some(n_evicted) = logged {
            let limit = self.capacity.total;
            tracing::warn!(
                n_open,
                limit,
                n_evicted,
                "too many connections, dropping those without an authenticated call"
            );
        }
        let standing = AtomicU8::new(Standing::Unproven as u8);
        Seat {
            place: Arc::new(Place { admission: Arc::clone(self), id, standing }),
            evicted: Some(evicted),
            deadline: Some(Box::pin(tokio::time::sleep(FIRST_REQUEST))),
            ended: None,
        }
    }

    /// Evicts a connection because the system has no room for another one.
    pub(crate) fn make_room(&self) {
        self.book().evict(None, Instant::now());
    }
}

impl Book {
    fn add(&mut self, key: (Standing, u64), evictable: Evictable) {
        if let Some(peer) = evictable.peer {
            *self.per_peer.entry(peer).or_default() += 1;
        }
        self.evictable.insert(key, evictable);
    }

    fn remove(&mut self, key: (Standing, u64)) -> Option<Evictable> {
        let removed = self.evictable.remove(&key)?;
        if let Some(peer) = removed.peer
            && let Some(n) = self.per_peer.get_mut(&peer)
        {
            *n -= 1;
            if *n == 0 {
                self.per_peer.remove(&peer);
            }
        }
        Some(removed)
    }

    /// Evicts the connection that has proven least, of `peer` if one is given; returns whether there was one.
    fn evict(&mut self, peer: Option<IpAddr>, now: Instant) -> bool {
        let Some(key) = self.victim(peer, now) else { return false };
        let Some(victim) = self.remove(key) else { return false };
        // A connection that has closed meanwhile needs no telling.
        victim.evict.send(()).ok();
        true
    }

    fn victim(&self, peer: Option<IpAddr>, now: Instant) -> Option<(Standing, u64)> {
        let is_of_peer = |evictable: &Evictable| peer.is_none() || evictable.peer == peer;
        let oldest = |standing| {
            let mut found = self.evictable.range((standing, 0)..=(standing, u64::MAX));
            found.find(|(_, evictable)| is_of_peer(evictable))
        };
        let unproven = oldest(Standing::Unproven);
        let silent = unproven.filter(|(_, found)| now.duration_since(found.since) >= FRESH);
        let victim = silent.or_else(|| oldest(Standing::Requested)).or(unproven);
        victim.map(|(key, _)| *key)
    }
}

/// The address under which connections of `peer` are counted together; `None` for those that are not counted.
///
/// A host has a whole /64 of IPv6 addresses at its disposal. On loopback all clients have the same address.
fn counted(peer: IpAddr) -> Option<IpAddr> {
    match peer.to_canonical() {
        peer if peer.is_loopback() => None,
        IpAddr::V6(peer) => Some(Ipv6Addr::from_bits(peer.to_bits() >> 64 << 64).into()),
        peer => Some(peer),
    }
}

/// A connection's place among those of its service, shared with the calls that come over it.
#[derive(Debug)]
pub(crate) struct Place {
    admission: Arc<Admission>,
    id: u64,
    /// Changed under the book's lock only.
    standing: AtomicU8,
}

impl Place {
    /// Notes that a complete request has come.
    pub(crate) fn requested(&self) {
        self.rise(Standing::Requested);
    }

    /// Notes that a call has passed the guard.
    pub(crate) fn authenticated(&self) {
        self.rise(Standing::Authenticated);
    }

    fn standing(&self) -> Standing {
        match self.standing.load(Ordering::Acquire) {
            0 => Standing::Unproven,
            1 => Standing::Requested,
            _ => Standing::Authenticated,
        }
    }

    fn rise(&self, to: Standing) {
        if self.standing() >= to {
            return;
        }
        let mut book = self.admission.book();
        let from = self.standing();
        let has_room = book.n_authenticated < self.admission.capacity.authenticated;
        let to = if has_room { to } else { to.min(Standing::Requested) };
        if from >= to {
            return;
        }
        // One that is being evicted stays what it was.
        let Some(evictable) = book.remove((from, self.id)) else { return };
        if to == Standing::Authenticated {
            book.n_authenticated += 1;
        } else {
            book.add((to, self.id), evictable);
        }
        self.standing.store(to as u8, Ordering::Release);
    }

    fn leave(&self) {
        let mut book = self.admission.book();
        match self.standing() {
            Standing::Authenticated => book.n_authenticated -= 1,
            standing => drop(book.remove((standing, self.id))),
        }
        book.n_open -= 1;
        let waiting = book.waiting.take();
        drop(book);
        if let Some(waiting) = waiting {
            waiting.wake();
        }
    }
}

/// A connection's own side of its place: says when it must close.
#[derive(Debug)]
pub(crate) struct Seat {
    pub(crate) place: Arc<Place>,
    /// `None` once the connection cannot be evicted any more.
    evicted: Option<oneshot::Receiver<()>>,
    /// `None` once a request has come.
    deadline: Option<Pin<Box<Sleep>>>,
    /// Why the connection must close.
    ended: Option<Ended>,
}

#[derive(Debug, Clone, Copy)]
enum Ended {
    Evicted,
    Overdue,
}

impl Seat {
    /// Fails when the connection must close; else wakes the task once it must.
    pub(crate) fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        if self.ended.is_none() {
            self.ended = self.poll_end(context);
        }
        match self.ended {
            None => Ok(()),
            Some(Ended::Evicted) => Err(io::Error::new(
                io::ErrorKind::ConnectionAborted,
                "evicted: there are too many connections",
            )),
            Some(Ended::Overdue) => Err(io::Error::new(
                io::ErrorKind::TimedOut,
                format!("no request within {FIRST_REQUEST:?}"),
            )),
        }
    }

    fn poll_end(&mut self, context: &mut Context<'_>) -> Option<Ended> {
        if let Some(evicted) = &mut self.evicted {
            match Pin::new(evicted).poll(context) {
                Poll::Ready(Ok(())) => return Some(Ended::Evicted),
                Poll::Ready(Err(_)) => self.evicted = None,
                Poll::Pending => {}
            }
        }
        let deadline = self.deadline.as_mut()?;
        if self.place.standing() != Standing::Unproven {
            self.deadline = None;
            return None;
        }
        deadline.as_mut().poll(context).is_ready().then_some(Ended::Overdue)
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.place.leave();
    }
}

#[cfg(test)]
mod tests;
