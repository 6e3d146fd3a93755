//! The page, the JSON behind it and the metrics, over the Unix socket; in a real browser where there is one.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::site::{Site, disguised, work_in_disguise, write_cloud, write_gbuffer};
use harness::{Daemon, free_port};
use pbgi_proto::v1;
use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::Command;

#[test]
#[ignore = "the worker's part, run by the daemon of the other tests"]
fn disguised_worker() {
    work_in_disguise();
}

/// Status code, head and body.
fn get(daemon: &Daemon, path: &str, host: &str) -> (u32, String, Vec<u8>) {
    let mut stream = UnixStream::connect(daemon.folder.path().join("run/http.sock")).unwrap();
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
    )
    .unwrap();
    let mut bytes = Vec::new();
    stream.read_to_end(&mut bytes).unwrap();
    let end = bytes.windows(4).position(|window| window == b"\r\n\r\n").unwrap();
    let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let code = head.split(' ').nth(1).unwrap().parse().unwrap();
    (code, head, bytes[end + 4..].to_vec())
}

fn text(daemon: &Daemon, path: &str) -> String {
    let (code, _, body) = get(daemon, path, "localhost");
    let body = String::from_utf8(body).unwrap();
    assert_eq!(code, 200, "{path}: {body}");
    body
}

#[tokio::test]
async fn jobs_picture_and_metrics_can_be_seen() {
    let site = Site::new(512, 512);
    site.succeed("build", site.build("s.pbgi")).await;
    let options = v1::JobOptions {
        labels: [("show".to_owned(), "dune".to_owned())].into(),
        ..Default::default()
    };
    site.hold_after(60);
    site.submit_with("shade", site.shade("a.exr"), options).await.unwrap();
    site.reaches("shade", 60).await;
    let opaque = |body: &[u8]| body.chunks(4).filter(|pixel| pixel[3] == 255).count();
    let (code, head, half) = get(&site.daemon, "/api/jobs/shade/picture", "localhost");
    assert!(code == 200 && head.contains("x-width: 512"), "{head}");
    assert_eq!(half.len(), 512 * 512 * 4);
    assert!(
        opaque(&half) > 50 * 1_024 && opaque(&half) < 512 * 500,
        "{}",
        opaque(&half)
    );
    let running = text(&site.daemon, "/metrics");
    assert!(
        running.contains("pbgi_job_units_done{job=\"shade\",scene=\"s.pbgi\""),
        "{running}"
    );
    site.release();
    site.wait("shade").await;
    let (_, _, whole) = get(&site.daemon, "/api/jobs/shade/picture", "localhost");
    assert_eq!(opaque(&whole), 512 * 511);
    let metrics = text(&site.daemon, "/metrics");
    for part in [
        "pbgi_tiles_shaded_total{} 256",
        "pbgi_job_shading_calls{job=\"shade\",scene=\"s.pbgi\",user=\"",
        "show=\"dune\",shot=\"\"",
        "pbgi_job_redundant_reads",
        "pbgi_cache_frames_resident{pool=\"node\"}",
        "pbgi_jobs_ended_total{state=\"succeeded\"} 2",
        "pbgi_scene_receivers_shaded_total{scene=\"s.pbgi\"",
        "pbgi_healthy{} 1",
        "# EOF",
    ] {
        assert!(metrics.contains(part), "{part} is not in {metrics}");
    }
    // Three of each tile, says the worker in disguise.
    let local = metrics
        .lines()
        .find(|line| line.starts_with("pbgi_scene_page_requests_total{scene=\"s.pbgi\"") && line.contains("\"local\""));
    assert!(local.unwrap().ends_with(" 768.0"), "{local:?}");
    for name in dashboard_names() {
        assert!(
            [&running, &metrics].iter().any(|text| has(text, &name)),
            "the dashboard asks for {name}, which no scrape has"
        );
    }
    let jobs: serde_json::Value = serde_json::from_str(&text(&site.daemon, "/api/jobs")).unwrap();
    assert_eq!(
        (&jobs[0]["id"], &jobs[0]["state"]),
        (&"shade".into(), &"succeeded".into())
    );
    assert_eq!(jobs[0]["labels"]["show"], "dune");
    let status: serde_json::Value = serde_json::from_str(&text(&site.daemon, "/api/status")).unwrap();
    assert_eq!(status["workers"].as_array().unwrap().len(), 2);
    assert_eq!(text(&site.daemon, "/healthz"), "serving\n");
    let (code, head, _) = get(&site.daemon, "/", "localhost:1234");
    assert!(
        code == 200 && head.contains("content-security-policy: default-src 'none'"),
        "{head}"
    );
    // A name that leads here from elsewhere is refused.
    assert_eq!(get(&site.daemon, "/api/jobs", "evil.example").0, 403);
    assert_eq!(get(&site.daemon, "/api/jobs/nobody/picture", "localhost").0, 404);
    site.daemon.stop();
}

/// The queries of the dashboard.
fn dashboard_queries() -> Vec<String> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/grafana-dashboard.json");
    let dashboard: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    let targets = panels
        .iter()
        .flat_map(|panel| panel["targets"].as_array().into_iter().flatten());
    targets
        .map(|target| target["expr"].as_str().unwrap().to_owned())
        .collect()
}

/// The metrics that the dashboard asks for.
fn dashboard_names() -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    for query in dashboard_queries() {
        let words = query.split(|letter: char| !letter.is_ascii_alphanumeric() && letter != '_');
        names.extend(words.filter(|word| word.starts_with("pbgi_")).map(ToOwned::to_owned));
    }
    assert!(names.len() >= 24, "{names:?}");
    names
}

/// Whether a scrape has a value under this name.
fn has(scrape: &str, name: &str) -> bool {
    scrape.lines().any(|line| line.split(['{', ' ']).next() == Some(name))
}

/// A site whose page is on a loopback port as well.
fn site_on_tcp() -> (Site, u16) {
    let port = free_port();
    let daemon = Daemon::start(disguised, |command| {
        let state = command
            .get_args()
            .skip_while(|word| *word != "--state-dir")
            .nth(1)
            .unwrap();
        let file = Path::new(state).parent().unwrap().join("server.toml");
        std::fs::write(&file, format!("[http]\naddress = \"127.0.0.1:{port}\"\n")).unwrap();
        command.arg("--config").arg(file);
    });
    write_cloud(&daemon.folder.path().join("in.ply"), 20_000);
    let gbuffer = write_gbuffer(&daemon.folder.path().join("g.exr"), 512, 512);
    (Site { daemon, gbuffer }, port)
}

/// Screenshots go where `PBGI_SCREENSHOTS` says.
#[tokio::test]
#[ignore = "needs Chromium: cargo test -p pbgi-server --test http -- --ignored --nocapture page_shows"]
async fn page_shows_the_picture_appearing_in_a_real_browser() {
    if Command::new("chromium").arg("--version").output().is_err() {
        eprintln!("SKIPPED: no chromium here, the page was not looked at");
        return;
    }
    let (site, port) = site_on_tcp();
    site.succeed("build-hall", site.build("s.pbgi")).await;
    site.submit("shade-hall", site.shade("a.exr")).await.unwrap();
    site.reaches("shade-hall", 40).await;
    let pause = v1::PauseJobRequest {
        job_id: "shade-hall".into(),
        reason: String::new(),
    };
    let browser = |name: &str, arguments: &[&str]| {
        let profile = site.daemon.folder.path().join(name);
        let output = Command::new("chromium")
            .args([
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--window-size=1100,1000",
                "--virtual-time-budget=6000",
            ])
            .arg(format!("--user-data-dir={}", profile.display()))
            .args(arguments)
            .arg(format!("http://127.0.0.1:{port}/"))
            .output()
            .unwrap();
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    let dom = browser("dom", &["--dump-dom"]);
    let shown = dom
        .split("data-shown=\"")
        .nth(1)
        .and_then(|rest| rest.split('"').next()?.parse::<f64>().ok());
    assert!(
        shown.is_some_and(|share| share > 0.1),
        "{shown:?} of the picture is shown: {dom}"
    );
    for part in [
        "shade-hall",
        "build-hall",
        "class=\"good\">serving",
        "worker 1",
        "submitted",
    ] {
        assert!(dom.contains(part), "{part} is not on the page: {dom}");
    }
    if let Some(folder) = std::env::var_os("PBGI_SCREENSHOTS") {
        let path = Path::new(&folder).join("page.png");
        browser("shot", &[&format!("--screenshot={}", path.display())]);
        assert!(path.metadata().unwrap().len() > 10_000);
    }
    let _ = site.daemon.jobs().await.pause_job(pause).await;
    site.daemon.stop();
}

#[tokio::test]
#[ignore = "needs Prometheus: cargo test -p pbgi-server --test http -- --ignored --nocapture every_query"]
async fn every_query_of_the_dashboard_is_answered_by_a_real_prometheus() {
    if Command::new("prometheus").arg("--version").output().is_err() {
        eprintln!("SKIPPED: no prometheus here, the dashboard's queries were not run");
        return;
    }
    let (site, port) = site_on_tcp();
    site.succeed("build", site.build("s.pbgi")).await;
    // Enough to do while Prometheus looks.
    for number in 0..40 {
        site.submit(&format!("shade-{number}"), site.shade(&format!("{number}.exr")))
            .await
            .unwrap();
    }
    let folder = site.daemon.folder.path().join("prometheus");
    std::fs::create_dir(&folder).unwrap();
    let deployed = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/prometheus.yml");
    let config = std::fs::read_to_string(deployed).unwrap();
    let config = config
        .replace("127.0.0.1:9464", &format!("127.0.0.1:{port}"))
        .replace("15s", "1s");
    std::fs::write(folder.join("prometheus.yml"), config).unwrap();
    let api = free_port();
    let mut prometheus = Command::new("prometheus")
        .arg(format!("--config.file={}", folder.join("prometheus.yml").display()))
        .arg(format!("--storage.tsdb.path={}", folder.join("data").display()))
        .arg(format!("--web.listen-address=127.0.0.1:{api}"))
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let queries = dashboard_queries();
    assert!(queries.len() >= 12, "{queries:?}");
    let ask = |query: &str| {
        let mut stream = std::net::TcpStream::connect(("127.0.0.1", api)).ok()?;
        let encoded: String = query.bytes().map(|byte| format!("%{byte:02X}")).collect();
        write!(
            stream,
            "GET /api/v1/query?query={encoded} HTTP/1.0\r\nHost: localhost\r\n\r\n"
        )
        .ok()?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer).ok()?;
        Some(answer)
    };
    let deadline = std::time::Instant::now() + std::time::Duration::from_secs(30);
    let empty = loop {
        tokio::time::sleep(std::time::Duration::from_secs(1)).await;
        let mut empty = Vec::new();
        for query in queries.iter().map(|query| query.replace("$__rate_interval", "1m")) {
            let answer = ask(&query).unwrap_or_default();
            assert!(!answer.contains("\"status\":\"error\""), "{query}: {answer}");
            if !answer.contains("\"status\":\"success\"") || answer.contains("\"result\":[]") {
                empty.push(query);
            }
        }
        if empty.is_empty() || std::time::Instant::now() > deadline {
            break empty;
        }
    };
    prometheus.kill().unwrap();
    prometheus.wait().unwrap();
    println!(
        "{} queries answered, {} of them with nothing: {empty:?}",
        queries.len(),
        empty.len()
    );
    assert!(empty.is_empty(), "queries that find nothing: {empty:?}");
    for number in 0..40 {
        let request = v1::CancelJobRequest {
            job_id: format!("shade-{number}"),
            ..Default::default()
        };
        site.daemon.jobs().await.cancel_job(request).await.unwrap();
    }
    site.daemon.stop();
}
