//! Validation of certificates and keys before they are used.

use rustls::RootCertStore;
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::sign::CertifiedKey;

/// An error in a certificate or key.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// The PEM contains no certificate.
    #[error("there is no certificate in PEM (-----BEGIN CERTIFICATE-----)")]
    NoCertificate,
    /// The PEM contains no unencrypted private key.
    #[error("there is no private key in PEM that is not encrypted (-----BEGIN PRIVATE KEY-----)")]
    NoKey,
    /// The PEM is truncated or not base64.
    #[error("the PEM is damaged")]
    Damaged(#[source] rustls::pki_types::pem::Error),
    /// The certificate belongs to another key.
    #[error("the private key is not the certificate's")]
    OtherKey,
    /// The certificate or key is damaged or of an unsupported kind.
    #[error("it cannot be used")]
    Unusable(#[source] rustls::Error),
}

/// Checks that a service can use this certificate chain with this key (PEM).
pub(crate) fn check_identity(certificate: &[u8], key: &[u8]) -> Result<(), TlsError> {
    let chain = certificates(certificate)?;
    let key = PrivateKeyDer::from_pem_slice(key).map_err(|error| match error {
        rustls::pki_types::pem::Error::NoItemsFound => TlsError::NoKey,
        error => TlsError::Damaged(error),
    })?;
    match CertifiedKey::from_der(chain, key, &ring::default_provider()) {
        Ok(_) => Ok(()),
        Err(rustls::Error::InconsistentKeys(_)) => Err(TlsError::OtherKey),
        Err(error) => Err(TlsError::Unusable(error)),
    }
}

/// Checks that a client can use these certificates (PEM) as trusted authorities.
pub(crate) fn check_authority(authority: &[u8]) -> Result<(), TlsError> {
    let mut trusted = RootCertStore::empty();
    certificates(authority)?
        .into_iter()
        .try_for_each(|certificate| trusted.add(certificate))
        .map_err(TlsError::Unusable)
}

fn certificates(pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let found: Vec<_> = CertificateDer::pem_slice_iter(pem)
        .map(|certificate| certificate.map(CertificateDer::into_owned))
        .collect::<Result<_, _>>()
        .map_err(TlsError::Damaged)?;
    if found.is_empty() { Err(TlsError::NoCertificate) } else { Ok(found) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair() -> (String, String) {
        let made = rcgen::generate_simple_self_signed(["localhost".to_owned()]).expect("made");
        (made.cert.pem(), made.signing_key.serialize_pem())
    }

    /// Replaces the content of a PEM text by other base64, which is not a certificate.
    fn garbled(pem: &str) -> String {
        let lines: Vec<&str> = pem.lines().collect();
        let (first, last) = (lines[0], lines[lines.len() - 1]);
        format!("{first}\nAAAAAAAAAAAAAAAA\n{last}\n")
    }

    #[test]
    fn a_certificate_requires_its_own_key() {
        let ((certificate, key), (_, other_key)) = (pair(), pair());
        let check = |certificate: &str, key: &str| {
            check_identity(certificate.as_bytes(), key.as_bytes()).map_err(|e| format!("{e:?}"))
        };
        assert_eq!(check(&certificate, &key), Ok(()));
        for (certificate, key, expected) in [
            (&certificate, &other_key, "OtherKey"),
            (&certificate, &certificate, "NoKey"),
            (&certificate, &String::new(), "NoKey"),
            (&key, &key, "NoCertificate"),
            (&certificate.replace("END", "UND"), &key, "Damaged"),
            (&garbled(&certificate), &key, "Unusable"),
            (&certificate, &garbled(&key), "Unusable"),
        ] {
            let error = check(certificate, key).expect_err("must be refused");
            assert!(error.starts_with(expected), "{error} is not {expected}");
        }
    }

    #[test]
    fn an_authority_needs_at_least_one_certificate_and_no_invalid_one() {
        let ((one, key), (other, _)) = (pair(), pair());
        let check = |pem: &str| check_authority(pem.as_bytes()).map_err(|e| format!("{e:?}"));
        assert_eq!(check(&one), Ok(()));
        assert_eq!(check(&format!("two of them\n{one}\n{other}")), Ok(()));
        for (pem, expected) in [
            ("", "NoCertificate"),
            ("not PEM at all", "NoCertificate"),
            (key.as_str(), "NoCertificate"),
            (&format!("{one}{}", garbled(&other)), "Unusable"),
            (&one[..one.len() / 2], "Damaged"),
        ] {
            let error = check(pem).expect_err("must be refused");
            assert!(error.starts_with(expected), "{error} is not {expected}");
        }
    }
}
