//! The configuration file: TOML with strict keys, and every problem in it on a line of its own.

use crate::access::{Access, Auth, Call, Root, Tcp, Token};
use crate::budget::parse_bytes;
use nix::unistd::{Gid, Group, Uid, User};
use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// What a file says; what it leaves out is `None`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ConfigFile {
    /// Where the sockets are made.
    pub runtime_dir: Option<PathBuf>,
    /// Where lock, job table and log are.
    pub state_dir: Option<PathBuf>,
    /// Where builds put temporary files.
    pub scratch_dir: Option<PathBuf>,
    /// All memory, bytes.
    pub memory: Option<u64>,
    /// Worker processes.
    pub workers: Option<u64>,
    /// Seconds without jobs after which the daemon exits.
    pub idle_seconds: Option<u64>,
    /// Nodes in the largest node page.
    pub nodes_per_page: Option<u64>,
    /// Points in the largest point page.
    pub points_per_page: Option<u64>,
    /// Log filter.
    pub log: Option<String>,
    /// `text` or `json`.
    pub log_format: Option<String>,
    /// The collector that spans go to, `http://HOST:PORT`.
    pub otlp: Option<String>,
    /// Who may do what.
    pub access: Access,
}

impl ConfigFile {
    /// Reads a file's text.
    ///
    /// # Errors
    /// A line for each problem.
    pub fn parse(text: &str) -> Result<Self, Vec<String>> {
        let table = match text.parse::<Table>() {
            Ok(table) => table,
            Err(error) => return Err(vec![error.to_string().trim().replace('\n', " ")]),
        };
        let mut problems = Vec::new();
        let mut file = Section::new("", table, &mut problems);
        let mut config = Self {
            runtime_dir: file.path("runtime_dir"),
            state_dir: file.path("state_dir"),
            scratch_dir: file.path("scratch_dir"),
            memory: file.read("memory", "a size like \"8G\"", |value| {
                parse_bytes(value.as_str()?).ok()
            }),
            workers: file.number("workers"),
            idle_seconds: file.number("idle_seconds"),
            nodes_per_page: file.number("nodes_per_page"),
            points_per_page: file.number("points_per_page"),
            log: file.text("log"),
            log_format: file.read("log_format", "\"text\" or \"json\"", |value| {
                let format = value.as_str()?;
                ["text", "json"].contains(&format).then(|| format.to_owned())
            }),
            otlp: None,
            access: Access::default(),
        };
        let users = file.read("allow_users", "a list of user names and numbers", |value| {
            value.as_array()?.iter().map(user).collect::<Option<Vec<Uid>>>()
        });
        config.access.users = users.unwrap_or_default();
        config.access.group = file.read("group", "a group that exists", group);
        let (roots, tcp, http) = (file.section("roots"), file.section("tcp"), file.section("http"));
        let otlp = file.section("otlp");
        file.end();
        for (name, value) in roots.unwrap_or_default() {
            config.root(&name, value, &mut problems);
        }
        config.access.tcp = tcp.and_then(|table| read_tcp(table, &mut problems));
        config.access.http = http.and_then(|table| read_http(table, &mut problems));
        config.otlp = otlp.and_then(|table| read_otlp(table, &mut problems));
        config.check_together(&mut problems);
        if problems.is_empty() { Ok(config) } else { Err(problems) }
    }

    fn root(&mut self, name: &str, value: Value, problems: &mut Vec<String>) {
        let Value::Table(table) = value else {
            problems.push(format!("roots.{name} must be a section: [roots.{name}]"));
            return;
        };
        if name.is_empty()
            || !name
                .bytes()
                .all(|byte| byte.is_ascii_alphanumeric() || b"_-".contains(&byte))
        {
            problems.push(format!("roots.{name:?} must be named with A-Z a-z 0-9 _ -"));
        }
        let prefix = format!("roots.{name}.");
        let mut section = Section::new(&prefix, table, problems);
        let path = section.path("path");
        let mut flag = |key| section.read(key, "true or false", Value::as_bool).unwrap_or(false);
        let (read, write, overwrite) = (flag("read"), flag("write"), flag("overwrite"));
        section.end();
        match path {
            None => problems.push(format!("roots.{name}.path is missing")),
            Some(_) if !read && !write => problems.push(format!("roots.{name} grants nothing: set read or write")),
            Some(path) => {
                let root = Root {
                    path,
                    read,
                    write,
                    overwrite,
                };
                self.access.roots.insert(name.to_owned(), root);
            }
        }
    }

    fn check_together(&self, problems: &mut Vec<String>) {
        if self.access.roots.is_empty() && self.access.others_may_call() {
            problems.push(NO_ROOTS.to_owned());
        }
    }
}

/// What is wrong where others may call and there are no roots.
pub(crate) const NO_ROOTS: &str = "others may call, so [roots.NAME] must say which files they may name";

fn read_tcp(table: Table, problems: &mut Vec<String>) -> Option<Tcp> {
    let mut section = Section::new("tcp.", table, problems);
    let address = section.address("address");
    let [cert, key, client_ca, token] = ["cert", "key", "client_ca", "token_file"].map(|key| section.path(key));
    let auth = section.read("auth", "\"mutual_tls\" or \"DANGEROUSLY_INSECURE\"", |value| {
        let auth = value.as_str()?;
        ["mutual_tls", "DANGEROUSLY_INSECURE"]
            .contains(&auth)
            .then(|| auth.to_owned())
    });
    let named = section.section("tokens");
    section.end();
    let mut tokens: Vec<Token> = Vec::new();
    tokens.extend(token.map(|file| Token {
        file,
        calls: Call::ALL.into(),
    }));
    for (name, value) in named.unwrap_or_default() {
        tokens.extend(read_token(&name, value, problems));
    }
    let Some(address) = address else {
        problems.push("tcp.address is missing".to_owned());
        return None;
    };
    if auth.as_deref() == Some("DANGEROUSLY_INSECURE") {
        if !address.ip().is_loopback() {
            problems.push(format!(
                "tcp.auth is DANGEROUSLY_INSECURE, so tcp.address must be loopback, not {address}"
            ));
        }
        return Some(Tcp {
            address,
            auth: Auth::DangerouslyInsecure,
        });
    }
    match (cert, key, client_ca) {
        (Some(cert), Some(key), Some(client_ca)) => Some(Tcp {
            address,
            auth: Auth::MutualTls {
                cert,
                key,
                client_ca,
                tokens,
            },
        }),
        _ => {
            problems.push("tcp needs cert, key and client_ca: calls over TCP are by mutual TLS".to_owned());
            None
        }
    }
}

fn read_token(name: &str, value: Value, problems: &mut Vec<String>) -> Option<Token> {
    let Value::Table(table) = value else {
        problems.push(format!("tcp.tokens.{name} must be a section: [tcp.tokens.{name}]"));
        return None;
    };
    let prefix = format!("tcp.tokens.{name}.");
    let mut section = Section::new(&prefix, table, problems);
    let file = section.path("file");
    let calls = section.read("calls", "a list out of \"look\", \"work\", \"operate\"", |value| {
        let call = |word: &Value| Call::ALL.into_iter().find(|call| Some(call.name()) == word.as_str());
        let calls = value.as_array()?.iter().map(call).collect::<Option<BTreeSet<Call>>>()?;
        (!calls.is_empty()).then_some(calls)
    });
    section.end();
    match (file, calls) {
        (Some(file), Some(calls)) => Some(Token { file, calls }),
        _ => {
            problems.push(format!("tcp.tokens.{name} needs file and calls"));
            None
        }
    }
}

fn read_otlp(table: Table, problems: &mut Vec<String>) -> Option<String> {
    let mut section = Section::new("otlp.", table, problems);
    let endpoint = section.read("endpoint", "a collector like \"http://127.0.0.1:4317\"", |value| {
        let endpoint = value.as_str()?;
        let host = endpoint.strip_prefix("http://")?;
        (!host.is_empty()).then(|| endpoint.to_owned())
    });
    section.end();
    if !cfg!(feature = "otlp") {
        problems.push("otlp needs a pbgi-server that was built with --features otlp".to_owned());
    }
    endpoint
}

fn read_http(table: Table, problems: &mut Vec<String>) -> Option<SocketAddr> {
    let mut section = Section::new("http.", table, problems);
    let address = section.address("address");
    section.end();
    match address {
        Some(address) if !address.ip().is_loopback() => {
            problems.push(format!(
                "http.address must be loopback, not {address}: the page asks nobody who they are; put a proxy before it"
            ));
        }
        None => problems.push("http.address is missing".to_owned()),
        Some(_) => {}
    }
    address
}

fn user(value: &Value) -> Option<Uid> {
    match value {
        Value::Integer(uid) => u32::try_from(*uid).ok().map(Uid::from_raw),
        Value::String(name) => User::from_name(name).ok()?.map(|user| user.uid),
        _ => None,
    }
}

fn group(value: &Value) -> Option<Gid> {
    match value {
        Value::Integer(gid) => u32::try_from(*gid).ok().map(Gid::from_raw),
        Value::String(name) => Group::from_name(name).ok()?.map(|group| group.gid),
        _ => None,
    }
}

/// A table whose keys are taken out one by one; what is left is unknown.
struct Section<'a> {
    /// What comes before its keys.
    prefix: String,
    table: Table,
    known: Vec<&'static str>,
    problems: &'a mut Vec<String>,
}

impl<'a> Section<'a> {
    fn new(prefix: &str, table: Table, problems: &'a mut Vec<String>) -> Self {
        Self {
            prefix: prefix.to_owned(),
            table,
            known: Vec::new(),
            problems,
        }
    }

    fn read<T>(&mut self, key: &'static str, expected: &str, read: impl FnOnce(&Value) -> Option<T>) -> Option<T> {
        self.known.push(key);
        let value = self.table.remove(key)?;
        let taken = read(&value);
        if taken.is_none() {
            let prefix = &self.prefix;
            self.problems
                .push(format!("{prefix}{key} is {value}, must be {expected}"));
        }
        taken
    }

    fn text(&mut self, key: &'static str) -> Option<String> {
        self.read(key, "text", |value| Some(value.as_str()?.to_owned()))
    }

    fn number(&mut self, key: &'static str) -> Option<u64> {
        self.read(key, "a number, 0 or above", |value| {
            u64::try_from(value.as_integer()?).ok()
        })
    }

    fn path(&mut self, key: &'static str) -> Option<PathBuf> {
        self.read(key, "an absolute path", |value| {
            let path = Path::new(value.as_str()?);
            path.is_absolute().then(|| path.to_owned())
        })
    }

    fn address(&mut self, key: &'static str) -> Option<SocketAddr> {
        self.read(key, "an address like \"127.0.0.1:7878\"", |value| {
            value.as_str()?.parse().ok()
        })
    }

    fn section(&mut self, key: &'static str) -> Option<Table> {
        self.read(key, "a section", |value| value.as_table().cloned())
    }

    /// Names what nobody asked for, and what may have been meant.
    fn end(self) {
        for key in self.table.keys() {
            let prefix = &self.prefix;
            let near = self.known.iter().min_by_key(|known| distance(known, key));
            let meant = near.filter(|known| distance(known, key) <= key.len() / 3 + 1);
            let hint = meant.map_or_else(String::new, |known| format!("; {prefix}{known} was meant?"));
            self.problems.push(format!("{prefix}{key} is unknown{hint}"));
        }
    }
}

/// Letters to change, add or leave out to make one word of the other.
fn distance(a: &str, b: &str) -> usize {
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.bytes().enumerate() {
        let mut corner = i;
        row[0] = i + 1;
        for (j, y) in b.bytes().enumerate() {
            let changed = corner + usize::from(x != y);
            corner = row[j + 1];
            row[j + 1] = changed.min(row[j] + 1).min(corner + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_is_read() {
        let text = r#"
            runtime_dir = "/run/pbgi"
            state_dir = "/var/lib/pbgi"
            scratch_dir = "/var/cache/pbgi"
            memory = "8G"
            workers = 4
            idle_seconds = 60
            nodes_per_page = 256
            points_per_page = 1024
            log = "debug"
            log_format = "json"
            allow_users = ["root", 1000]
            group = 0
            [roots.shots]
            path = "/mnt/shots"
            read = true
            [roots.out]
            path = "/mnt/out"
            write = true
            overwrite = true
            [tcp]
            address = "0.0.0.0:7878"
            cert = "/c"
            key = "/k"
            client_ca = "/a"
            token_file = "/t"
            [tcp.tokens.dashboard]
            file = "/d"
            calls = ["look"]
            [http]
            address = "127.0.0.1:9464"
        "#;
        let config = ConfigFile::parse(text).unwrap();
        assert_eq!(config.memory, Some(8 << 30));
        assert_eq!(config.access.users, [Uid::from_raw(0), Uid::from_raw(1000)]);
        assert!(config.access.roots["out"].overwrite && !config.access.roots["shots"].write);
        let tokens = config.access.tokens();
        assert_eq!((tokens[0].file.as_path(), tokens[0].calls.len()), (Path::new("/t"), 3));
        assert_eq!(
            (tokens[1].file.as_path(), &tokens[1].calls),
            (Path::new("/d"), &[Call::Look].into())
        );
        assert_eq!(ConfigFile::parse("").unwrap(), ConfigFile::default());
    }

    #[test]
    fn every_problem_has_a_line_that_names_the_key() {
        let text = r#"
            memroy = "8G"
            workers = -1
            state_dir = "relative"
            log_format = "xml"
            allow_users = ["no-such-user-at-all"]
            [roots.a]
            path = "/a"
            [roots.b]
            read = true
            [tcp]
            address = "0.0.0.0:1"
            auth = "DANGEROUSLY_INSECURE"
            [http]
            address = "1.2.3.4:80"
            [otlp]
            endpoint = "127.0.0.1:4317"
        "#;
        let problems = ConfigFile::parse(text).unwrap_err();
        for part in [
            "memroy is unknown; memory was meant?",
            "workers is -1, must be",
            "state_dir is \"relative\", must be an absolute path",
            "log_format is \"xml\"",
            "allow_users",
            "roots.a grants nothing",
            "roots.b.path is missing",
            "tcp.address must be loopback",
            "http.address must be loopback",
            "otlp.endpoint is \"127.0.0.1:4317\", must be a collector like",
        ] {
            assert!(
                problems.iter().any(|problem| problem.contains(part)),
                "{part}: {problems:#?}"
            );
        }
        assert!(problems.iter().all(|problem| !problem.contains('\n')));
        let broken = ConfigFile::parse("memory =").unwrap_err();
        assert!(broken.len() == 1 && broken[0].contains("line 1"), "{broken:?}");
    }

    #[test]
    fn others_may_call_only_where_roots_say_what_they_may_name() {
        let tcp = "[tcp]\naddress = \"127.0.0.1:1\"\nauth = \"DANGEROUSLY_INSECURE\"";
        assert!(ConfigFile::parse(tcp).unwrap_err()[0].contains("[roots.NAME]"));
        let token = "[tcp]\naddress = \"127.0.0.1:1\"\n[tcp.tokens.a]\nfile = \"/t\"\ncalls = [\"lok\"]";
        let problems = ConfigFile::parse(token).unwrap_err().join("\n");
        assert!(
            problems.contains("tcp.tokens.a.calls is [\"lok\"], must be a list out of"),
            "{problems}"
        );
    }
}
