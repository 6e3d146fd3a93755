//! Who may call what: by the user at the other end of a Unix socket, by certificate and token over TCP.

use super::status::status;
use crate::access::{Access, Auth, Call, Token};
use crate::error::{JobError, JobErrorKind, ServerError};
use std::collections::BTreeSet;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::{Extensions, Request, Response};
use tonic::transport::server::{TcpConnectInfo, TlsConnectInfo, UdsConnectInfo};
use tower::{Layer, Service};

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
    pub(super) fn of(extensions: &tonic::Extensions) -> Self {
        Self::behind(
            extensions.get::<UdsConnectInfo>(),
            extensions.get::<TlsConnectInfo<TcpConnectInfo>>(),
        )
    }

    fn behind(user: Option<&UdsConnectInfo>, remote: Option<&TlsConnectInfo<TcpConnectInfo>>) -> Self {
        if let Some(info) = user {
            return Self::User(info.peer_cred.map(|peer| peer.uid()));
        }
        let certificates = remote.and_then(TlsConnectInfo::peer_certs);
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

/// What a caller may do; found with each request that was let in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Grants(Arc<BTreeSet<Call>>);

impl Grants {
    fn all() -> Self {
        Self(Arc::new(Call::ALL.into()))
    }

    /// Refuses what the caller of a request may not do.
    pub(super) fn ask(extensions: &tonic::Extensions, call: Call) -> Result<(), Status> {
        let granted = extensions.get::<Self>().is_some_and(|grants| grants.0.contains(&call));
        if granted { Ok(()) } else { Err(not_granted(call)) }
    }
}

fn not_granted(call: Call) -> Status {
    let text = format!("this token does not allow to {}", call.name());
    status(JobError::new(JobErrorKind::Denied, text))
}

/// Which sort of call a method is. What is not known here takes the most.
fn sort(path: &str) -> Call {
    // Health and reflection.
    if path.starts_with("/grpc.") {
        return Call::Look;
    }
    match path.strip_prefix("/pbgi.v1.").unwrap_or_default() {
        "JobService/GetJob"
        | "JobService/ListJobs"
        | "JobService/WatchJob"
        | "SceneService/GetScene"
        | "SceneService/GetSceneShape"
        | "DaemonService/GetStatus"
        | "DaemonService/GetCache" => Call::Look,
        "JobService/SubmitJob"
        | "JobService/CancelJob"
        | "JobService/PauseJob"
        | "JobService/ResumeJob"
        | "JobService/RetryJob"
        | "SceneService/WarmScene"
        | "ShadeService/ShadePoints" => Call::Work,
        _ => Call::Operate,
    }
}

/// The rules of one listener, which may change while it is served; clones share them.
#[derive(Clone, Debug)]
pub struct Gate(Arc<RwLock<Rules>>);

#[derive(Debug, PartialEq, Eq)]
struct Rules {
    uids: Vec<u32>,
    certificates: bool,
    anybody: bool,
    /// Tokens and what they allow; without any, whoever is let in may do everything.
    tokens: Vec<(String, Grants)>,
}

impl Gate {
    fn new(rules: Rules) -> Self {
        Self(Arc::new(RwLock::new(rules)))
    }

    /// For our own user only.
    pub fn own() -> Self {
        Self::users(&Access::default())
    }

    /// For our own user and those that the configuration allows.
    pub fn users(access: &Access) -> Self {
        let others = access.users.iter().map(|uid| uid.as_raw());
        Self::new(Rules {
            uids: others.chain([nix::unistd::geteuid().as_raw()]).collect(),
            certificates: false,
            anybody: false,
            tokens: Vec::new(),
        })
    }

    /// For callers over TCP.
    ///
    /// # Errors
    /// A token file that cannot be read, is too short, or can be read by others.
    pub fn remote(auth: &Auth) -> Result<Self, ServerError> {
        let (certificates, tokens) = match auth {
            Auth::DangerouslyInsecure => (false, Vec::new()),
            Auth::MutualTls { tokens, .. } => {
                let read = |token: &Token| Ok((read_token(&token.file)?, Grants(Arc::new(token.calls.clone()))));
                (true, tokens.iter().map(read).collect::<Result<_, ServerError>>()?)
            }
        };
        Ok(Self::new(Rules {
            uids: Vec::new(),
            certificates,
            anybody: !certificates,
            tokens,
        }))
    }

    /// Takes over the rules of another gate; whether they are others.
    pub fn change(&self, other: &Self) -> bool {
        let mut rules = Rules {
            uids: Vec::new(),
            certificates: false,
            anybody: false,
            tokens: Vec::new(),
        };
        std::mem::swap(&mut rules, &mut other.0.write().unwrap_or_else(PoisonError::into_inner));
        let mut own = self.0.write().unwrap_or_else(PoisonError::into_inner);
        let changed = *own != rules;
        *own = rules;
        changed
    }

    /// What a caller may do; `None` for one that is not known.
    fn admits(&self, caller: Caller, token: Option<&str>) -> Option<Grants> {
        let rules = self.0.read().unwrap_or_else(PoisonError::into_inner);
        let known = match caller {
            Caller::User(uid) => uid.is_some_and(|uid| rules.uids.contains(&uid)),
            Caller::Certificate(_) => rules.certificates,
            Caller::Anybody => rules.anybody,
        };
        if !known {
            return None;
        }
        if rules.tokens.is_empty() {
            return Some(Grants::all());
        }
        let given = token.unwrap_or_default();
        // All are compared, so that the time does not tell which it is.
        rules.tokens.iter().fold(None, |found, (wanted, grants)| {
            if same(given, wanted) {
                Some(grants.clone())
            } else {
                found
            }
        })
    }

    /// Lets a request in or not.
    fn check<B>(&self, request: &mut Request<B>) -> Result<(), Status> {
        let extensions: &Extensions = request.extensions();
        let caller = Caller::behind(
            extensions.get::<UdsConnectInfo>(),
            extensions.get::<TlsConnectInfo<TcpConnectInfo>>(),
        );
        let header = request
            .headers()
            .get("authorization")
            .and_then(|value| value.to_str().ok());
        let token = header.and_then(|header| header.strip_prefix("Bearer "));
        let Some(grants) = self.admits(caller, token) else {
            complain(caller);
            let text = "this caller is not known here: another user, certificate or token is needed";
            return Err(status(JobError::new(JobErrorKind::Unauthenticated, text)));
        };
        let call = sort(request.uri().path());
        if !grants.0.contains(&call) {
            return Err(not_granted(call));
        }
        request.extensions_mut().insert(grants);
        Ok(())
    }
}

impl<S> Layer<S> for Gate {
    type Service = Guarded<S>;

    fn layer(&self, inner: S) -> Guarded<S> {
        let gate = self.clone();
        Guarded { gate, inner }
    }
}

/// A service behind a gate.
#[derive(Clone, Debug)]
pub struct Guarded<S> {
    gate: Gate,
    inner: S,
}

impl<S, B> Service<Request<B>> for Guarded<S>
where
    S: Service<Request<B>, Response = Response<Body>>,
    S::Future: Send + 'static,
    S::Error: Send + 'static,
{
    type Response = S::Response;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<S::Response, S::Error>> + Send>>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(cx)
    }

    fn call(&mut self, mut request: Request<B>) -> Self::Future {
        match self.gate.check(&mut request) {
            Ok(()) => Box::pin(self.inner.call(request)),
            Err(status) => Box::pin(std::future::ready(Ok(status.into_http()))),
        }
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
        let tls = |tokens| Auth::MutualTls {
            cert: "/c".into(),
            key: "/k".into(),
            client_ca: "/a".into(),
            tokens,
        };
        let look = Token {
            file: file.clone(),
            calls: [Call::Look].into(),
        };
        let signed = Gate::remote(&tls(vec![look.clone()])).unwrap();
        let plain_tls = Gate::remote(&tls(Vec::new())).unwrap();
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
            (signed.clone(), certificate, None, false),
        ];
        for (index, (gate, caller, token, admitted)) in matrix.iter().enumerate() {
            assert_eq!(
                gate.admits(*caller, *token).is_some(),
                *admitted,
                "case {index}: {caller:?}"
            );
        }
        assert_eq!(
            signed.admits(certificate, Some(token)).unwrap().0,
            look.calls.clone().into()
        );
        // Taken over by a gate that is in use.
        assert!(signed.change(&Gate::remote(&tls(Vec::new())).unwrap()));
        assert_eq!(signed.admits(certificate, None), Some(Grants::all()));
        assert!(!signed.change(&Gate::remote(&tls(Vec::new())).unwrap()));
        println!(
            "RELIABILITY R11: {} of {} callers judged rightly",
            matrix.len(),
            matrix.len()
        );
        std::fs::set_permissions(&file, PermissionsExt::from_mode(0o644)).unwrap();
        let error = Gate::remote(&tls(vec![look])).unwrap_err().to_string();
        assert!(error.contains("644"), "{error}");
    }

    #[test]
    fn every_method_is_of_the_sort_that_it_should_be() {
        let text =
            std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../proto/pbgi/v1/jobs.proto")).unwrap();
        let mut service = "";
        let mut methods = Vec::new();
        for line in text.lines().map(str::trim) {
            if let Some(rest) = line.strip_prefix("service ") {
                service = rest.split(' ').next().unwrap();
            } else if let Some(rest) = line.strip_prefix("rpc ") {
                methods.push(format!("/pbgi.v1.{service}/{}", rest.split('(').next().unwrap()));
            }
        }
        let of = |call: Call| methods.iter().filter(|method| sort(method) == call).count();
        assert_eq!((of(Call::Look), of(Call::Work), of(Call::Operate)), (7, 7, 2));
        assert_eq!(sort("/grpc.health.v1.Health/Check"), Call::Look);
        assert_eq!(sort("/pbgi.v1.JobService/EraseJobs"), Call::Operate);
    }
}
