//! A daemon to work with, and jobs run on it to their end.

use super::args::{RunningArgs, ServerArgs};
use super::failure::Failure;
use super::interrupt::Interrupt;
use super::progress::Progress;
use pbgi_client::private::{Folders, server_program};
use pbgi_client::{BuildJob, Client, ClientError, Job, JobOptions, JobState, Refusal, ShadeJob};
use pbgi_core::Statistics;
use std::path::PathBuf;
use std::time::Duration;

/// A cancelled job stops within one tile.
const CANCEL_WAIT: Duration = Duration::from_secs(10);

/// What a job does.
pub(crate) enum Work {
    Build(BuildJob),
    Shade(ShadeJob),
}

/// Where this user's daemons and caches live.
pub(crate) fn folders() -> Result<Folders, Failure> {
    Ok(Folders::from_environment(|name| std::env::var_os(name))?)
}

/// The daemon that the options name, started if it is a private one that does not run.
pub(crate) async fn connect(
    server: &ServerArgs,
    interrupt: &Interrupt,
    progress: &Progress,
) -> Result<Client, Failure> {
    if let Some(uri) = &server.server {
        return interrupt.guard(named(uri)).await;
    }
    let own = std::env::current_exe();
    let own = own.map_err(|error| Failure::failed(format!("cannot tell where pbgi-client lies: {error}")))?;
    let program = server_program(&own)?;
    let folders = folders()?;
    let options = server.private_options();
    let mut say = |text: &str| progress.say(text);
    let client = interrupt
        .guard(async { Ok(folders.find_or_start(&program, &options, &mut say).await?) })
        .await?;
    Ok(client)
}

/// The daemon at an address that the user gave.
async fn named(uri: &str) -> Result<Client, Failure> {
    if !uri.starts_with("https://") {
        return Ok(Client::connect(uri).await?);
    }
    let variable = |name, below: &str| std::env::var_os(name).map(|base| PathBuf::from(base).join(below));
    let folder = variable("XDG_CONFIG_HOME", "pbgi/tls").or_else(|| variable("HOME", ".config/pbgi/tls"));
    let folder =
        folder.ok_or_else(|| Failure::failed("set HOME or XDG_CONFIG_HOME: certificates are in pbgi/tls there"))?;
    Ok(Client::connect_remote(uri, &folder).await?)
}

/// The daemons that run now and that the options mean; at least one.
pub(crate) async fn running(args: &RunningArgs) -> Result<Vec<Client>, Failure> {
    let clients = match &args.server {
        Some(uri) => vec![named(uri).await?],
        None => folders()?.running().await?,
    };
    if clients.is_empty() {
        return Err(Failure::failed(
            "no daemon of yours is running; name another one with --server, or start one with any job",
        ));
    }
    Ok(clients)
}

/// What each daemon that runs answers.
pub(crate) async fn ask_running<T>(
    args: &RunningArgs,
    interrupt: &Interrupt,
    question: impl AsyncFn(&Client) -> Result<T, ClientError>,
) -> Result<Vec<(Client, T)>, Failure> {
    let answers = async {
        let mut answers = Vec::new();
        for client in running(args).await? {
            let answer = question(&client).await?;
            answers.push((client, answer));
        }
        Ok(answers)
    };
    interrupt.guard(answers).await
}

/// The daemon that knows a job, and the job.
pub(crate) async fn find_job(args: &RunningArgs, id: &str) -> Result<(Client, Job), Failure> {
    for client in running(args).await? {
        match client.job(id).await {
            Ok(job) => return Ok((client, job)),
            Err(ClientError::Refused {
                refusal: Refusal::NotFound,
                ..
            }) => {}
            Err(error) => return Err(error.into()),
        }
    }
    Err(Failure::failed(format!(
        "no running daemon knows job {id:?}; \"pbgi-client jobs\" lists those there are"
    )))
}

/// Submits `work`, follows it, cancels it when the user interrupts. Returns the statistics of a job that succeeded.
pub(crate) async fn run(
    client: &Client,
    work: &Work,
    interrupt: &Interrupt,
    progress: &mut Progress,
) -> Result<Statistics, Failure> {
    let job = submit(client, work, None, &JobOptions::default(), progress).await?;
    follow(client, &job.id, interrupt, progress).await
}

/// Submits `work` under a name, or under one made up.
pub(crate) async fn submit(
    client: &Client,
    work: &Work,
    name: Option<&str>,
    options: &JobOptions,
    progress: &Progress,
) -> Result<Job, Failure> {
    let kind = match work {
        Work::Build(_) => "build",
        Work::Shade(_) => "shade",
    };
    // The id makes a repeated submit harmless; chance keeps those of different commands apart.
    let chance = || format!("{kind}-{:016x}", rand::random::<u64>());
    let id = name.map_or_else(chance, str::to_owned);
    // A command that is repeated after its daemon was killed finds its job under way.
    let options = JobOptions {
        attach: name.is_none(),
        ..options.clone()
    };
    let job = match work {
        Work::Build(job) => client.submit_build(&id, job, &options).await?,
        Work::Shade(job) => client.submit_shade(&id, job, &options).await?,
    };
    if job.id != id {
        progress.say(&format!("job {} is making this already: following it", job.id));
    }
    Ok(job)
}

/// Follows a job to its end, cancels it when the user interrupts. Returns the statistics of a job that succeeded.
pub(crate) async fn follow(
    client: &Client,
    id: &str,
    interrupt: &Interrupt,
    progress: &mut Progress,
) -> Result<Statistics, Failure> {
    let watched = tokio::select! {
        job = client.watch(id, |job| progress.job(job)) => Some(job?),
        () = interrupt.wait() => None,
    };
    match watched {
        Some(job) => ended(&job),
        None => Err(cancelled(client, id, progress).await),
    }
}

/// Cancels on behalf of the user, and says what became of the job.
async fn cancelled(client: &Client, id: &str, progress: &mut Progress) -> Failure {
    progress.stage("cancelling");
    if let Err(error) = client.cancel(id, "interrupted").await {
        return Failure::Interrupted(format!("job {id} could not be cancelled: {error}"));
    }
    match tokio::time::timeout(CANCEL_WAIT, client.watch(id, |_| {})).await {
        Ok(Ok(job)) if job.state == JobState::Succeeded => {
            Failure::Interrupted(format!("job {id} was done before it could be cancelled"))
        }
        Ok(Ok(_)) => Failure::Interrupted(format!("job {id} is cancelled, nothing was written")),
        Ok(Err(_)) | Err(_) => Failure::Interrupted(format!("job {id} is being cancelled")),
    }
}

/// The statistics of a job that succeeded.
pub(crate) fn ended(job: &Job) -> Result<Statistics, Failure> {
    match job.state {
        JobState::Succeeded => Ok(job.statistics.clone()),
        JobState::Cancelled => Err(Failure::failed(format!("job {} was cancelled", job.id))),
        _ => Err(Failure::failed(format!("cannot {}: {}", job.title, job.error))),
    }
}
