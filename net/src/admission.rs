//! Admission control: the number of connections that a service keeps, and which one it evicts to admit another.
//!
//! A new connection is always admitted. When the capacity is exhausted, the least trusted connection is evicted: first
//! one that has not made a request in a while, then one that has made no authenticated call, the oldest first. An
//! authenticated connection is never evicted, and a reserve of connections is never given to authenticated ones. A
//! client with the token therefore gets through, regardless of the connections that others hold open.

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

/// The deadline of the first request on a connection, including the TLS handshake.
pub(crate) const FIRST_REQUEST: Duration = Duration::from_secs(10);
/// The age up to which a connection without a request is not the first to be evicted.
const FRESH: Duration = Duration::from_secs(1);
/// The minimum time between two log lines about evictions.
const LOG_EVERY: Duration = Duration::from_secs(60);

/// The maximum number of connections of a service without a limit on open files.
const MOST: usize = 16_384;
/// The open files that a service needs besides its connections: ledger or run directory, logs, outgoing connections.
const OTHER_FILES: usize = 64;
/// The maximum number of connections of a [`TextEndpoint`](crate::TextEndpoint); a further one replaces the oldest one
/// without a request.
pub(crate) const MOST_OF_TEXT: usize = 16;
/// The maximum number of connections of a dashboard.
const MOST_OF_DASHBOARD: usize = 256;
/// The number of connections that is reserved for unauthenticated ones.
const RESERVE: usize = 32;

/// The number of connections that a service keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Capacity {
    /// The limit on all connections.
    total: usize,
    /// The limit on authenticated connections.
    authenticated: usize,
    /// The limit per address on connections without an authenticated call. Loopback addresses have no such limit.
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

    /// Returns the capacity of the service of a process with a limit of `limit` open files; `None` means no limit.
    ///
    /// The service leaves files to the process itself, to a dashboard and to a [`TextEndpoint`](crate::TextEndpoint),
    /// even if it has no such pages.
    #[must_use]
    pub fn for_open_files(limit: Option<u64>) -> Self {
        let pages = Self::of_dashboard(limit).total + MOST_OF_TEXT;
        let limit = n_files(limit);
        Self::of(limit - OTHER_FILES.min(limit / 4) - pages.min(limit / 4))
    }

    /// Returns the capacity of the dashboard of a process with a limit of `limit` open files: an eighth of them, at
    /// most 256.
    #[must_use]
    pub fn of_dashboard(limit: Option<u64>) -> Self {
        Self::of((n_files(limit) / 8).min(MOST_OF_DASHBOARD))
    }

    /// Returns the limit on all connections.
    #[must_use]
    pub const fn total(self) -> usize {
        self.total
    }
}

fn n_files(limit: Option<u64>) -> usize {
    limit.and_then(|limit| usize::try_from(limit).ok()).unwrap_or(usize::MAX)
}

impl Default for Capacity {
    fn default() -> Self {
        Self::of(MOST)
    }
}

/// The trust in a connection, in ascending order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
enum Trust {
    /// No request has arrived.
    New,
    /// A request has arrived, but without a valid token, or the limit on authenticated connections was reached.
    Requested,
    /// A call has passed the token check.
    Authenticated,
}

/// The connections of one service.
#[derive(Debug)]
pub(crate) struct Admission {
    capacity: Capacity,
    registry: Mutex<Registry>,
}

#[derive(Debug, Default)]
struct Registry {
    next_id: u64,
    /// Connections that can be evicted, by trust and age.
    evictable: BTreeMap<(Trust, u64), Evictable>,
    /// The number of evictable connections of each address.
    per_peer: BTreeMap<IpAddr, usize>,
    n_authenticated: usize,
    /// The number of connections that hold a file, including those being evicted.
    n_open: usize,
    /// The task that is woken when a connection has closed.
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
        Arc::new(Self { capacity, registry: Mutex::default() })
    }

    fn registry(&self) -> MutexGuard<'_, Registry> {
        self.registry.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the number of open connections.
    pub(crate) fn n_open(&self) -> usize {
        self.registry().n_open
    }

    /// Waits until the number of open connections is within the capacity, that is, until evicted ones have closed.
    pub(crate) fn poll_room(&self, context: &Context<'_>) -> Poll<()> {
        let mut registry = self.registry();
        if registry.n_open <= self.capacity.total {
            return Poll::Ready(());
        }
        registry.waiting = Some(context.waker().clone());
        Poll::Pending
    }

    /// Admits a connection from `peer`, evicting another one if necessary.
    pub(crate) fn admit(self: &Arc<Self>, peer: Option<IpAddr>) -> AdmissionPermit {
        let now = Instant::now();
        let peer = peer.and_then(counting_key);
        let mut registry = self.registry();
        let of_peer =
            peer.and_then(|peer| registry.per_peer.get(&peer)).copied().unwrap_or_default();
        let evicts = if of_peer >= self.capacity.unauthenticated_per_peer {
            registry.evict(peer, now)
        } else if registry.n_open >= self.capacity.total {
            registry.evict(None, now)
        } else {
            false
        };
        let logged = if evicts { registry.log.pass(now, LOG_EVERY) } else { None };
        let (evict, evicted) = oneshot::channel();
        let id = registry.next_id;
        registry.next_id += 1;
        registry.n_open += 1;
        registry.add((Trust::New, id), Evictable { peer, since: now, evict });
        let n_open = registry.n_open;
        drop(registry);
        if let Some(n_evicted) = logged {
            let limit = self.capacity.total;
            tracing::warn!(
                n_open,
                limit,
                n_evicted,
                "too many connections, dropping those without an authenticated call"
            );
        }
        let trust = AtomicU8::new(Trust::New as u8);
        AdmissionPermit {
            handle: Arc::new(AdmissionHandle { admission: Arc::clone(self), id, trust }),
            evicted: Some(evicted),
            deadline: Some(Box::pin(tokio::time::sleep(FIRST_REQUEST))),
            closing: None,
        }
    }

    /// Evicts a connection because the system has no room for another one.
    pub(crate) fn make_room(&self) {
        self.registry().evict(None, Instant::now());
    }
}

impl Registry {
    fn add(&mut self, key: (Trust, u64), evictable: Evictable) {
        if let Some(peer) = evictable.peer {
            *self.per_peer.entry(peer).or_default() += 1;
        }
        self.evictable.insert(key, evictable);
    }

    fn remove(&mut self, key: (Trust, u64)) -> Option<Evictable> {
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

    /// Evicts the least trusted connection, of `peer` if one is given; returns whether there was one.
    fn evict(&mut self, peer: Option<IpAddr>, now: Instant) -> bool {
        let Some(key) = self.victim(peer, now) else { return false };
        let Some(victim) = self.remove(key) else { return false };
        // Fails only for a connection that has closed meanwhile.
        victim.evict.send(()).ok();
        true
    }

    fn victim(&self, peer: Option<IpAddr>, now: Instant) -> Option<(Trust, u64)> {
        let is_of_peer = |evictable: &Evictable| peer.is_none() || evictable.peer == peer;
        let oldest = |trust| {
            let mut found = self.evictable.range((trust, 0)..=(trust, u64::MAX));
            found.find(|(_, evictable)| is_of_peer(evictable))
        };
        let unproven = oldest(Trust::New);
        let silent = unproven.filter(|(_, found)| now.duration_since(found.since) >= FRESH);
        let victim = silent.or_else(|| oldest(Trust::Requested)).or(unproven);
        victim.map(|(key, _)| *key)
    }
}

/// Returns the address under which connections of `peer` are counted together; `None` for loopback addresses, which all
/// local clients share.
///
/// IPv6 addresses are counted by /64 prefix, because one host may use all addresses of a prefix.
fn counting_key(peer: IpAddr) -> Option<IpAddr> {
    match peer.to_canonical() {
        peer if peer.is_loopback() => None,
        IpAddr::V6(peer) => Some(Ipv6Addr::from_bits(peer.to_bits() >> 64 << 64).into()),
        peer => Some(peer),
    }
}

/// A handle to a connection's entry in the registry, shared with the calls on that connection.
#[derive(Debug)]
pub(crate) struct AdmissionHandle {
    admission: Arc<Admission>,
    id: u64,
    /// Changed only while the registry is locked.
    trust: AtomicU8,
}

impl AdmissionHandle {
    /// Records that a complete request has arrived.
    pub(crate) fn mark_requested(&self) {
        self.promote(Trust::Requested);
    }

    /// Records that a call has passed the token check.
    pub(crate) fn mark_authenticated(&self) {
        self.promote(Trust::Authenticated);
    }

    fn trust(&self) -> Trust {
        match self.trust.load(Ordering::Acquire) {
            0 => Trust::New,
            1 => Trust::Requested,
            _ => Trust::Authenticated,
        }
    }

    fn promote(&self, to: Trust) {
        if self.trust() >= to {
            return;
        }
        let mut registry = self.admission.registry();
        let from = self.trust();
        let has_room = registry.n_authenticated < self.admission.capacity.authenticated;
        let to = if has_room { to } else { to.min(Trust::Requested) };
        if from >= to {
            return;
        }
        // A connection that is being evicted is no longer in the registry and keeps its trust.
        let Some(evictable) = registry.remove((from, self.id)) else { return };
        if to == Trust::Authenticated {
            registry.n_authenticated += 1;
        } else {
            registry.add((to, self.id), evictable);
        }
        self.trust.store(to as u8, Ordering::Release);
    }

    fn leave(&self) {
        let mut registry = self.admission.registry();
        match self.trust() {
            Trust::Authenticated => registry.n_authenticated -= 1,
            trust => drop(registry.remove((trust, self.id))),
        }
        registry.n_open -= 1;
        let waiting = registry.waiting.take();
        drop(registry);
        if let Some(waiting) = waiting {
            waiting.wake();
        }
    }
}

/// A connection's permit. It signals when the connection must close, and releases its entry when it is dropped.
#[derive(Debug)]
pub(crate) struct AdmissionPermit {
    pub(crate) handle: Arc<AdmissionHandle>,
    /// `None` once the connection can no longer be evicted.
    evicted: Option<oneshot::Receiver<()>>,
    /// `None` once a request has arrived.
    deadline: Option<Pin<Box<Sleep>>>,
    closing: Option<CloseReason>,
}

#[derive(Debug, Clone, Copy)]
enum CloseReason {
    Evicted,
    Overdue,
}

impl AdmissionPermit {
    /// Returns an error when the connection must close; otherwise registers the task to be woken when it must.
    pub(crate) fn check(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        if self.closing.is_none() {
            self.closing = self.poll_close(context);
        }
        match self.closing {
            None => Ok(()),
            Some(CloseReason::Evicted) => Err(io::Error::new(
                io::ErrorKind::ConnectionAborted,
                "evicted: there are too many connections",
            )),
            Some(CloseReason::Overdue) => Err(io::Error::new(
                io::ErrorKind::TimedOut,
                format!("no request within {FIRST_REQUEST:?}"),
            )),
        }
    }

    fn poll_close(&mut self, context: &mut Context<'_>) -> Option<CloseReason> {
        if let Some(evicted) = &mut self.evicted {
            match Pin::new(evicted).poll(context) {
                Poll::Ready(Ok(())) => return Some(CloseReason::Evicted),
                Poll::Ready(Err(_)) => self.evicted = None,
                Poll::Pending => {}
            }
        }
        let deadline = self.deadline.as_mut()?;
        if self.handle.trust() != Trust::New {
            self.deadline = None;
            return None;
        }
        deadline.as_mut().poll(context).is_ready().then_some(CloseReason::Overdue)
    }
}

impl Drop for AdmissionPermit {
    fn drop(&mut self) {
        self.handle.leave();
    }
}

#[cfg(test)]
mod tests;
