//! What others may do: roots for files, mutual TLS and tokens over TCP, and nothing else.
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod harness;

use harness::site::{Site, check_picture, disguised, work_in_disguise, write_cloud, write_gbuffer};
use harness::{Daemon, free_port, wait_until};
use pbgi_proto::v1;
use pbgi_proto::v1::daemon_service_client::DaemonServiceClient;
use pbgi_proto::v1::job_service_client::JobServiceClient;
use pbgi_proto::v1::queue_service_client::QueueServiceClient;
use pbgi_proto::v1::submit_job_request::Task;
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Code, Request};

#[test]
#[ignore = "the worker's part, run by the daemon of the other tests"]
fn disguised_worker() {
    work_in_disguise();
}

/// A daemon with the configuration that `text` makes of its folder, and two roots: `in` to read, `out` to write.
fn daemon(text: impl FnOnce(&Path) -> String) -> Daemon {
    Daemon::start(disguised, |command| {
        let state = command
            .get_args()
            .skip_while(|word| *word != "--state-dir")
            .nth(1)
            .unwrap();
        let folder = Path::new(state).parent().unwrap().to_owned();
        for name in ["in", "out", "secret"] {
            std::fs::create_dir(folder.join(name)).unwrap();
        }
        let roots = format!(
            "\n[roots.in]\npath = \"{0}/in\"\nread = true\n[roots.out]\npath = \"{0}/out\"\nread = true\nwrite = true\n",
            folder.display()
        );
        let file = folder.join("server.toml");
        std::fs::write(&file, roots + &text(&folder)).unwrap();
        command.arg("--config").arg(file);
    })
}

fn site(daemon: Daemon) -> Site {
    let folder = daemon.folder.path();
    write_cloud(&folder.join("in/in.ply"), 20_000);
    let gbuffer = write_gbuffer(&folder.join("in/g.exr"), 64, 64);
    Site { daemon, gbuffer }
}

fn build(input: &str, output: &str) -> Task {
    Task::Build(v1::BuildTask {
        inputs: vec![input.into()],
        output: output.into(),
        ..Default::default()
    })
}

/// A picture with light that was reflected up to three times.
fn shade_bounces(scene: &str, gbuffer: &str, output: &str) -> Task {
    Task::Shade(v1::ShadeTask {
        scene: scene.into(),
        gbuffer: gbuffer.into(),
        output: output.into(),
        settings: Some(v1::ShadeSettings {
            bounces: Some(3),
            ..Default::default()
        }),
        ..Default::default()
    })
}

fn shade(scene: &str, gbuffer: &str, output: &str) -> Task {
    Task::Shade(v1::ShadeTask {
        scene: scene.into(),
        gbuffer: gbuffer.into(),
        output: output.into(),
        ..Default::default()
    })
}

#[tokio::test]
async fn jobs_stay_within_their_roots_and_errors_do_not_tell_where_these_are() {
    let site = site(daemon(|_| String::new()));
    let folder = site.daemon.folder.path().to_owned();
    site.succeed("build", build("in:in.ply", "out:s.pbgi")).await;
    site.succeed("shade", shade("out:s.pbgi", "in:g.exr", "out:a.exr"))
        .await;
    check_picture(&folder.join("out/a.exr"), &site.gbuffer);
    // Scenes of further bounces are made outside of all roots, from one that is in a root.
    let grey = Task::Build(v1::BuildTask {
        inputs: vec!["in:in.ply".into()],
        output: "out:grey.pbgi".into(),
        cloud: Some(v1::CloudSettings {
            albedo: Some(0.5),
            ..Default::default()
        }),
        ..Default::default()
    });
    site.succeed("grey", grey).await;
    site.succeed("bounces", shade_bounces("out:grey.pbgi", "in:g.exr", "out:bounces.exr"))
        .await;
    check_picture(&folder.join("out/bounces.exr"), &site.gbuffer);
    site.submit("black", shade_bounces("out:s.pbgi", "in:g.exr", "out:black.exr"))
        .await
        .unwrap();
    let black = site.wait("black").await;
    assert_eq!(black.state(), v1::JobState::Failed);
    let hidden = !black.error.contains(&*folder.to_string_lossy()) && !black.error.contains("/proc");
    assert!(hidden && black.error.contains("out:s.pbgi"), "{}", black.error);
    for (id, task, code) in [
        (
            "absolute",
            shade("/etc", "in:g.exr", "out:b.exr"),
            Code::InvalidArgument,
        ),
        (
            "above",
            shade("out:s.pbgi", "in:../secret/g.exr", "out:b.exr"),
            Code::InvalidArgument,
        ),
        (
            "read-only",
            shade("out:s.pbgi", "in:g.exr", "in:b.exr"),
            Code::PermissionDenied,
        ),
        (
            "unknown",
            shade("out:s.pbgi", "else:g.exr", "out:b.exr"),
            Code::InvalidArgument,
        ),
        ("no-root", build("in.ply", "out:t.pbgi"), Code::InvalidArgument),
    ] {
        assert_eq!(site.submit(id, task).await.unwrap_err().code(), code, "{id}");
    }
    std::os::unix::fs::symlink("../secret/g.exr", folder.join("in/link.exr")).unwrap();
    std::fs::copy(folder.join("in/g.exr"), folder.join("secret/g.exr")).unwrap();
    std::fs::write(folder.join("in/bad.exr"), "no picture").unwrap();
    for (id, gbuffer) in [
        ("link", "in:link.exr"),
        ("bad", "in:bad.exr"),
        ("missing", "in:missing.exr"),
    ] {
        site.submit(id, shade("out:s.pbgi", gbuffer, "out:b.exr"))
            .await
            .unwrap();
        let job = site.wait(id).await;
        assert_eq!(job.state(), v1::JobState::Failed, "{id}");
        let hidden = !job.error.contains(&*folder.to_string_lossy()) && !job.error.contains("/proc");
        assert!(hidden && job.error.contains(gbuffer), "{id}: {}", job.error);
    }
    // The old picture may not be replaced: the root does not grant it.
    let overwrite = Task::Shade(v1::ShadeTask {
        scene: "out:s.pbgi".into(),
        gbuffer: "in:g.exr".into(),
        output: "out:a.exr".into(),
        overwrite: true,
        ..Default::default()
    });
    assert_eq!(
        site.submit("again", overwrite).await.unwrap_err().code(),
        Code::PermissionDenied
    );
    site.daemon.stop();
}

#[tokio::test]
async fn root_that_is_added_while_the_daemon_runs_can_be_named_and_one_that_is_taken_away_cannot() {
    let site = site(daemon(|_| String::new()));
    let folder = site.daemon.folder.path().to_owned();
    let file = folder.join("server.toml");
    let old = std::fs::read_to_string(&file).unwrap();
    std::fs::rename(folder.join("secret"), folder.join("more")).unwrap();
    let task = || build("in:in.ply", "more:s.pbgi");
    assert_eq!(
        site.submit("early", task()).await.unwrap_err().code(),
        Code::InvalidArgument
    );
    let more = format!("[roots.more]\npath = \"{}/more\"\nwrite = true\n", folder.display());
    std::fs::write(&file, old.clone() + &more).unwrap();
    let hang_up = |times: usize| {
        site.daemon.signal("-HUP");
        let told = || site.daemon.log().matches("roots changed, nothing").count();
        wait_until("the roots change", || told() == times);
    };
    hang_up(1);
    site.succeed("build", task()).await;
    std::fs::write(&file, old).unwrap();
    hang_up(2);
    assert_eq!(
        site.submit("late", task()).await.unwrap_err().code(),
        Code::InvalidArgument
    );
    site.daemon.stop();
}

#[tokio::test]
async fn mesh_that_names_files_outside_its_root_cannot_have_them() {
    let site = site(daemon(|_| String::new()));
    let folder = site.daemon.folder.path().to_owned();
    let triangle: Vec<u8> = [[0_f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        .concat()
        .into_iter()
        .flat_map(f32::to_le_bytes)
        .collect();
    let mesh = |uri: &str| {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"buffers":[{{"uri":"{uri}","byteLength":36}}],
            "bufferViews":[{{"buffer":0,"byteLength":36}}],
            "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
            "nodes":[{{"mesh":0}}],"scenes":[{{"nodes":[0]}}],"scene":0}}"#
        )
    };
    std::fs::write(folder.join("secret/buffer.bin"), &triangle).unwrap();
    std::fs::write(folder.join("in/buffer.bin"), &triangle).unwrap();
    std::fs::write(folder.join("in/good.gltf"), mesh("buffer.bin")).unwrap();
    std::os::unix::fs::symlink(folder.join("secret/buffer.bin"), folder.join("in/link.bin")).unwrap();
    std::fs::write(folder.join("in/bad.gltf"), mesh("link.bin")).unwrap();
    let task = |input: &str, output: &str| {
        Task::Build(v1::BuildTask {
            inputs: vec![input.into()],
            output: output.into(),
            density: Some(v1::build_task::Density::Points(1_000)),
            ..Default::default()
        })
    };
    site.succeed("good", task("in:good.gltf", "out:good.pbgi")).await;
    site.submit("bad", task("in:bad.gltf", "out:bad.pbgi")).await.unwrap();
    let job = site.wait("bad").await;
    assert_eq!(job.state(), v1::JobState::Failed);
    assert!(job.error.contains("ermission denied"), "{}", job.error);
    site.daemon.stop();
}

/// A certificate authority and what it signs.
struct Authority(CertifiedIssuer<'static, KeyPair>);

impl Authority {
    fn new() -> Self {
        let mut params = CertificateParams::new(Vec::<String>::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        Self(CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap())
    }

    /// Certificate and key, PEM.
    fn sign(&self, name: &str) -> (String, String) {
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec![name.to_owned()]).unwrap();
        let certificate = params.signed_by(&key, &self.0).unwrap();
        (certificate.pem(), key.serialize_pem())
    }

    fn pem(&self) -> String {
        self.0.pem()
    }
}

async fn call(endpoint: Endpoint, token: Option<&str>) -> Result<v1::DaemonStatus, Code> {
    let channel: Channel = endpoint.connect().await.map_err(|_| Code::Unavailable)?;
    let mut request = Request::new(v1::GetStatusRequest {});
    if let Some(token) = token {
        let header = format!("Bearer {token}").parse().unwrap();
        request.metadata_mut().insert("authorization", header);
    }
    let answer = DaemonServiceClient::new(channel).get_status(request).await;
    answer.map(tonic::Response::into_inner).map_err(|status| status.code())
}

#[tokio::test]
async fn tcp_asks_for_a_certificate_of_ours_and_the_token() {
    let (ours, theirs, port) = (Authority::new(), Authority::new(), free_port());
    let token = "a-token-of-more-than-32-characters-for-tests";
    let looker = "l-token-of-more-than-32-characters-for-tests";
    let secret = |path: &Path, text: &str| {
        std::fs::write(path, text).unwrap();
        std::fs::set_permissions(path, PermissionsExt::from_mode(0o600)).unwrap();
    };
    let daemon = daemon(|folder| {
        let (cert, key) = ours.sign("localhost");
        for (name, text) in [
            ("cert", cert.as_str()),
            ("key", &key),
            ("ca", &ours.pem()),
            ("token", token),
            ("looker", looker),
        ] {
            secret(&folder.join(name), text);
        }
        let folder = folder.display();
        format!(
            "[tcp]\naddress = \"127.0.0.1:{port}\"\ncert = \"{folder}/cert\"\nkey = \"{folder}/key\"\n\
             client_ca = \"{folder}/ca\"\ntoken_file = \"{folder}/token\"\n\
             [tcp.tokens.dashboard]\nfile = \"{folder}/looker\"\ncalls = [\"look\"]\n"
        )
    });
    let uri = format!("https://localhost:{port}");
    let endpoint = |authority: Option<&Authority>| {
        let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(ours.pem()));
        if let Some(authority) = authority {
            let (cert, key) = authority.sign("a client");
            tls = tls.identity(Identity::from_pem(cert, key));
        }
        Endpoint::from_shared(uri.clone()).unwrap().tls_config(tls).unwrap()
    };
    let status = call(endpoint(Some(&ours)), Some(token)).await.unwrap();
    assert_eq!(status.pid, daemon.child.id());
    assert_eq!(
        call(endpoint(Some(&ours)), None).await.unwrap_err(),
        Code::Unauthenticated
    );
    let wrong = "b-token-of-more-than-32-characters-for-tests";
    assert_eq!(
        call(endpoint(Some(&ours)), Some(wrong)).await.unwrap_err(),
        Code::Unauthenticated
    );
    for stranger in [endpoint(None), endpoint(Some(&theirs))] {
        assert!(call(stranger, Some(token)).await.is_err());
    }
    let plain = Endpoint::from_shared(format!("http://localhost:{port}")).unwrap();
    assert!(call(plain, Some(token)).await.is_err());
    // A token that allows to look allows nothing else.
    let channel = endpoint(Some(&ours)).connect().await.unwrap();
    let header: tonic::metadata::MetadataValue<_> = format!("Bearer {looker}").parse().unwrap();
    let signed = |mut request: Request<()>| {
        request.metadata_mut().insert("authorization", header.clone());
        Ok(request)
    };
    let mut jobs = JobServiceClient::with_interceptor(channel.clone(), signed);
    let mut operator = DaemonServiceClient::with_interceptor(channel, signed);
    assert!(jobs.list_jobs(v1::ListJobsRequest::default()).await.is_ok());
    let watch = v1::WatchJobRequest {
        job_id: "x".into(),
        cancel_on_disconnect: true,
    };
    for refused in [
        jobs.submit_job(v1::SubmitJobRequest::default()).await.err(),
        jobs.cancel_job(v1::CancelJobRequest::default()).await.err(),
        jobs.watch_job(watch).await.err(),
        operator.shutdown(v1::ShutdownRequest {}).await.err(),
    ] {
        assert_eq!(refused.unwrap().code(), Code::PermissionDenied);
    }
    // A new secret holds without a restart, and the old one does not.
    secret(&daemon.folder.path().join("token"), wrong);
    daemon.signal("-HUP");
    wait_until("the token changes", || daemon.log().contains("tokens changed, nothing"));
    assert!(call(endpoint(Some(&ours)), Some(wrong)).await.is_ok());
    assert_eq!(
        call(endpoint(Some(&ours)), Some(token)).await.unwrap_err(),
        Code::Unauthenticated
    );
    // Secrets are in no log, no argument and no variable of the daemon.
    let process = |file: &str| std::fs::read(format!("/proc/{}/{file}", daemon.child.id())).unwrap();
    for text in [daemon.log().into_bytes(), process("cmdline"), process("environ")] {
        let text = String::from_utf8_lossy(&text);
        assert!([token, looker, wrong].iter().all(|secret| !text.contains(secret)));
    }
    daemon.stop();
}

#[tokio::test]
async fn plain_tcp_serves_loopback_clients_but_never_workers() {
    let port = free_port();
    let daemon = daemon(|_| format!("[tcp]\naddress = \"127.0.0.1:{port}\"\nauth = \"DANGEROUSLY_INSECURE\"\n"));
    let endpoint = Endpoint::from_shared(format!("http://127.0.0.1:{port}")).unwrap();
    assert_eq!(call(endpoint.clone(), None).await.unwrap().pid, daemon.child.id());
    let mut queue = QueueServiceClient::new(endpoint.connect().await.unwrap());
    let refused = queue.lease_tile(v1::LeaseTileRequest::default()).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unimplemented);
    assert!(daemon.log().contains("DANGEROUSLY INSECURE"), "{}", daemon.log());
    println!("RELIABILITY R10: the workers' service answers UNIMPLEMENTED to clients over TCP");
    daemon.stop();
}
