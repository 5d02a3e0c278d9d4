//! One owner at a time.

/// What an owner is known by. Whoever makes tokens has to make them hard to guess.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Token(pub u128);

impl std::fmt::Debug for Token {
    /// A token is a secret.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token(..)")
    }
}

/// Why somebody may not do what only the owner may.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum LeaseError {
    /// Somebody else owns the arms.
    #[error(
        "the arms are owned by another client for another {expires_in_s:.1} s unless it renews its lease"
    )]
    Held {
        /// When the lease ends if its owner stays silent, seconds from now.
        expires_in_s: f64,
    },
    /// Nobody owns the arms: the lease has ended, or there was none.
    #[error("the arms have no owner: acquire them first")]
    Nobody,
}

/// Who owns the arms, and since when they have been silent.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Lease {
    held: Option<Held>,
}

#[derive(Debug, Clone, Copy)]
struct Held {
    token: Token,
    heard_s: f64,
}

impl Lease {
    /// Makes whoever has `token` the owner, or renews their lease.
    pub(crate) fn acquire(
        &mut self,
        token: Token,
        now_s: f64,
        lease_s: f64,
    ) -> Result<(), LeaseError> {
        match self.held {
            Some(held) if held.token != token && now_s - held.heard_s < lease_s => {
                Err(LeaseError::Held { expires_in_s: held.heard_s + lease_s - now_s })
            }
            _ => {
                self.held = Some(Held { token, heard_s: now_s });
                Ok(())
            }
        }
    }

    /// Notes that the owner was heard.
    pub(crate) fn renew(
        &mut self,
        token: Token,
        now_s: f64,
        lease_s: f64,
    ) -> Result<(), LeaseError> {
        match self.held {
            Some(held) if now_s - held.heard_s >= lease_s => Err(LeaseError::Nobody),
            Some(_) => self.acquire(token, now_s, lease_s),
            None => Err(LeaseError::Nobody),
        }
    }

    pub(crate) fn release(&mut self) {
        self.held = None;
    }

    /// How long the owner has been silent, seconds; infinite when there is none.
    pub(crate) fn silent_s(&self, now_s: f64) -> f64 {
        self.held.map_or(f64::INFINITY, |held| now_s - held.heard_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEASE_S: f64 = 5.0;
    const ANN: Token = Token(1);
    const BOB: Token = Token(2);

    #[test]
    fn the_arms_have_one_owner_at_a_time() {
        let mut lease = Lease::default();
        assert_eq!(lease.renew(ANN, 0.0, LEASE_S), Err(LeaseError::Nobody));
        assert_eq!(lease.acquire(ANN, 0.0, LEASE_S), Ok(()));
        let held = Err(LeaseError::Held { expires_in_s: 3.0 });
        assert_eq!(lease.acquire(BOB, 2.0, LEASE_S), held);
        assert_eq!(lease.renew(BOB, 2.0, LEASE_S), held);
        assert_eq!(lease.renew(ANN, 4.0, LEASE_S), Ok(()));
        assert!((lease.silent_s(6.5) - 2.5).abs() < 1e-12);
        assert!(lease.acquire(BOB, 8.9, LEASE_S).is_err());
    }

    #[test]
    fn a_lease_that_has_ended_is_anybodys() {
        let mut lease = Lease::default();
        lease.acquire(ANN, 0.0, LEASE_S).unwrap();
        assert_eq!(lease.renew(ANN, 5.0, LEASE_S), Err(LeaseError::Nobody));
        assert_eq!(lease.acquire(BOB, 5.0, LEASE_S), Ok(()));
        assert!(lease.renew(ANN, 5.1, LEASE_S).is_err());
        lease.release();
        assert_eq!(lease.acquire(ANN, 5.2, LEASE_S), Ok(()));
    }
}
