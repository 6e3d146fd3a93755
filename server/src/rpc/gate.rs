//! Who may call: by the user at the other end of a Unix socket, by certificate and token over TCP.

use super::status::status;
use crate::access::{Access, Auth};
use crate::error::{JobError, JobErrorKind, ServerError};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tonic::transport::server::{TcpConnectInfo, TlsConnectInfo, UdsConnectInfo};
use tonic::{Extensions, Request, Status};

/// Characters that a token has at least.
const TOKEN_CHARS_MIN: usize = 32;

/// Who is at the other end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Caller {
    /// A process of this machine; `None` if the kernel does not say whose.
    User(Option<u32>),
    /// Somebody with a certificate that our authority signed; a number made from it.
    Certificate(u32),
    /// Somebody over plain TCP.
    Anybody,
}

impl Caller {
    /// From what the transport says about a connection.
    pub(super) fn of(extensions: &Extensions) -> Self {
        if let Some(info) = extensions.get::<UdsConnectInfo>() {
            return Self::User(info.peer_cred.map(|peer| peer.uid()));
        }
        let certificates = extensions
            .get::<TlsConnectInfo<TcpConnectInfo>>()
            .and_then(TlsConnectInfo::peer_certs);
        match certificates.as_ref().and_then(|chain| chain.first()) {
            Some(certificate) => Self::Certificate(crc32c::crc32c(certificate)),
            None => Self::Anybody,
        }
    }

    /// A name for job records.
    pub(super) fn name(self) -> String {
        match self {
            Self::User(Some(uid)) => {
                let user = nix::unistd::User::from_uid(uid.into()).ok().flatten();
                user.map_or_else(|| uid.to_string(), |user| user.name)
            }
            Self::Certificate(number) => format!("certificate-{number:08x}"),
            Self::User(None) | Self::Anybody => "anybody".to_owned(),
        }
    }
}

/// The rules of one listener.
#[derive(Clone, Debug)]
pub(super) struct Gate(Arc<Rules>);

#[derive(Debug)]
struct Rules {
    uids: Vec<u32>,
    certificates: bool,
    anybody: bool,
    token: Option<String>,
}

impl Gate {
    /// For our own user only.
    pub(super) fn own() -> Self {
        Self(Arc::new(Rules {
            uids: vec![nix::unistd::geteuid().as_raw()],
            certificates: false,
            anybody: false,
            token: None,
        }))
    }

    /// For our own user and those that the configuration allows.
    pub(super) fn users(access: &Access) -> Self {
        let others = access.users.iter().map(|uid| uid.as_raw());
        Self(Arc::new(Rules {
            uids: others.chain([nix::unistd::geteuid().as_raw()]).collect(),
            certificates: false,
            anybody: false,
            token: None,
        }))
    }

    /// For callers over TCP.
    ///
    /// # Errors
    /// A token file that cannot be read, is too short, or can be read by others.
    pub(super) fn remote(auth: &Auth) -> Result<Self, ServerError> {
        let (certificates, anybody, token) = match auth {
            Auth::DangerouslyInsecure => (false, true, None),
            Auth::MutualTls { token, .. } => (true, false, token.as_deref().map(read_token).transpose()?),
        };
        Ok(Self(Arc::new(Rules {
            uids: Vec::new(),
            certificates,
            anybody,
            token,
        })))
    }

    fn admits(&self, caller: Caller, token: Option<&str>) -> bool {
        let known = match caller {
            Caller::User(uid) => uid.is_some_and(|uid| self.0.uids.contains(&uid)),
            Caller::Certificate(_) => self.0.certificates,
            Caller::Anybody => self.0.anybody,
        };
        known
            && self
                .0
                .token
                .as_deref()
                .is_none_or(|wanted| token.is_some_and(|token| same(token, wanted)))
    }

    /// Lets a request in or not.
    pub(super) fn check(&self, request: Request<()>) -> Result<Request<()>, Status> {
        let caller = Caller::of(request.extensions());
        let header = request
            .metadata()
            .get("authorization")
            .and_then(|value| value.to_str().ok());
        let token = header.and_then(|header| header.strip_prefix("Bearer "));
        if self.admits(caller, token) {
            return Ok(request);
        }
        complain(caller);
        let text = "this caller is not known here: another user, certificate or token is needed";
        Err(status(JobError::new(JobErrorKind::Unauthenticated, text)))
    }
}

/// Compares in a time that does not tell where the difference is.
fn same(given: &str, wanted: &str) -> bool {
    let bytes = given.bytes().zip(wanted.bytes());
    given.len() == wanted.len() && bytes.fold(0, |all, (a, b)| all | (a ^ b)) == 0
}

fn read_token(path: &Path) -> Result<String, ServerError> {
    let text = read_secret(path)?;
    let token = text.trim();
    if token.len() < TOKEN_CHARS_MIN || !token.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Err(ServerError::Setup {
            action: "take the token",
            reason: format!(
                "it must be {TOKEN_CHARS_MIN} printable characters or more, in {}",
                path.display()
            ),
        });
    }
    Ok(token.to_owned())
}

/// Reads a file that nobody else may read.
///
/// # Errors
/// It cannot be read, or others could.
pub(super) fn read_secret(path: &Path) -> Result<String, ServerError> {
    let text = std::fs::read_to_string(path).map_err(ServerError::io("read a secret", path))?;
    let mode = std::fs::metadata(path)
        .map_err(ServerError::io("inspect a secret", path))?
        .mode();
    if mode & 0o077 != 0 {
        return Err(ServerError::Setup {
            action: "use a secret that others can read",
            reason: format!("its mode is {:o}, make it 600, at {}", mode & 0o777, path.display()),
        });
    }
    Ok(text)
}

/// One line a minute, whoever knocks.
fn complain(caller: Caller) {
    const INTERVAL: Duration = Duration::from_secs(60);
    static LAST: Mutex<Option<Instant>> = Mutex::new(None);
    let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
    if last.is_none_or(|last| last.elapsed() > INTERVAL) {
        *last = Some(Instant::now());
        tracing::warn!(?caller, "refused a caller");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::unistd::Uid;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn strangers_wrong_users_and_bad_tokens_are_refused() {
        let own = nix::unistd::geteuid().as_raw();
        let friend = own + 1;
        let access = Access {
            users: vec![Uid::from_raw(friend)],
            ..Access::default()
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("token");
        let token = "0123456789abcdef0123456789abcdef";
        std::fs::write(&file, format!("{token}\n")).unwrap();
        std::fs::set_permissions(&file, PermissionsExt::from_mode(0o600)).unwrap();
        let tls = |token| Auth::MutualTls {
            cert: "/c".into(),
            key: "/k".into(),
            client_ca: "/a".into(),
            token,
        };
        let signed = Gate::remote(&tls(Some(file.clone()))).unwrap();
        let plain_tls = Gate::remote(&tls(None)).unwrap();
        let certificate = Caller::Certificate(1);
        let wrong = "0123456789abcdef0123456789abcdeF";
        let matrix = [
            (Gate::own(), Caller::User(Some(own)), None, true),
            (Gate::own(), Caller::User(Some(friend)), None, false),
            (Gate::own(), Caller::User(None), None, false),
            (Gate::own(), certificate, None, false),
            (Gate::own(), Caller::Anybody, None, false),
            (Gate::users(&access), Caller::User(Some(friend)), None, true),
            (Gate::users(&access), Caller::User(Some(friend + 1)), None, false),
            (plain_tls.clone(), certificate, None, true),
            (plain_tls, Caller::Anybody, None, false),
            (signed.clone(), certificate, Some(token), true),
            (signed.clone(), certificate, Some(wrong), false),
            (signed, certificate, None, false),
        ];
        for (index, (gate, caller, token, admitted)) in matrix.iter().enumerate() {
            assert_eq!(gate.admits(*caller, *token), *admitted, "case {index}: {caller:?}");
        }
        println!(
            "RELIABILITY R11: {} of {} callers judged rightly",
            matrix.len(),
            matrix.len()
        );
        std::fs::set_permissions(&file, PermissionsExt::from_mode(0o644)).unwrap();
        let error = Gate::remote(&tls(Some(file))).unwrap_err().to_string();
        assert!(error.contains("644"), "{error}");
    }
}
