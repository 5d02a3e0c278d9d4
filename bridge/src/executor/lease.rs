//! The lease of the arms: one owner at a time.

/// Identifies an owner. Tokens must be hard to guess.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Token(pub u128);

impl std::fmt::Debug for Token {
    /// Hides the token, which is a secret.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token(..)")
    }
}

/// A client asked for something that only the owner may do.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum LeaseError {
    /// Another client owns the arms.
    #[error(
        "the arms are owned by another client for another {expires_in_s:.1} s unless it renews its lease"
    )]
    Held {
        /// The time until the lease ends unless its owner renews it, seconds.
        expires_in_s: f64,
    },
    /// The arms have no owner: the lease has ended, or there was none.
    #[error("the arms have no owner: acquire them first")]
    NotOwned,
}

/// The owner of the arms and the time of its last sign of life.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Lease {
    held: Option<Held>,
}

#[derive(Debug, Clone, Copy)]
struct Held {
    token: Token,
    renewed_s: f64,
}

impl Lease {
    /// Makes the client with `token` the owner, or renews its lease.
    pub(crate) fn acquire(
        &mut self,
        token: Token,
        now_s: f64,
        lease_s: f64,
    ) -> Result<(), LeaseError> {
        match self.held {
            Some(held) if held.token != token && now_s - held.renewed_s < lease_s => {
                Err(LeaseError::Held { expires_in_s: held.renewed_s + lease_s - now_s })
            }
            _ => {
                self.held = Some(Held { token, renewed_s: now_s });
                Ok(())
            }
        }
    }

    /// Renews the owner's lease.
    pub(crate) fn renew(
        &mut self,
        token: Token,
        now_s: f64,
        lease_s: f64,
    ) -> Result<(), LeaseError> {
        match self.held {
            Some(held) if now_s - held.renewed_s >= lease_s => Err(LeaseError::NotOwned),
            Some(_) => self.acquire(token, now_s, lease_s),
            None => Err(LeaseError::NotOwned),
        }
    }

    pub(crate) fn release(&mut self) {
        self.held = None;
    }

    /// The time since the owner's last sign of life, seconds; infinite if there is no owner.
    pub(crate) fn silent_s(&self, now_s: f64) -> f64 {
        self.held.map_or(f64::INFINITY, |held| now_s - held.renewed_s)
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
        assert_eq!(lease.renew(ANN, 0.0, LEASE_S), Err(LeaseError::NotOwned));
        assert_eq!(lease.acquire(ANN, 0.0, LEASE_S), Ok(()));
        let held = Err(LeaseError::Held { expires_in_s: 3.0 });
        assert_eq!(lease.acquire(BOB, 2.0, LEASE_S), held);
        assert_eq!(lease.renew(BOB, 2.0, LEASE_S), held);
        assert_eq!(lease.renew(ANN, 4.0, LEASE_S), Ok(()));
        assert!((lease.silent_s(6.5) - 2.5).abs() < 1e-12);
        assert!(lease.acquire(BOB, 8.9, LEASE_S).is_err());
    }

    #[test]
    fn any_client_can_acquire_a_lease_that_has_ended() {
        let mut lease = Lease::default();
        lease.acquire(ANN, 0.0, LEASE_S).unwrap();
        assert_eq!(lease.renew(ANN, 5.0, LEASE_S), Err(LeaseError::NotOwned));
        assert_eq!(lease.acquire(BOB, 5.0, LEASE_S), Ok(()));
        assert!(lease.renew(ANN, 5.1, LEASE_S).is_err());
        lease.release();
        assert_eq!(lease.acquire(ANN, 5.2, LEASE_S), Ok(()));
    }
}
