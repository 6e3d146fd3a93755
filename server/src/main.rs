//! The `pbgi-server` program.
#![forbid(unsafe_code)]

mod cli;
mod process;

use clap::Parser;
use cli::{Arguments, LogFormat, ServeArguments};
use pbgi_server::budget::Machine;
use pbgi_server::state::{StateDir, make_directories};
use pbgi_server::{Config, Listeners, ServerError, Stop, build_child};
use std::io::Write;
use std::process::ExitCode;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;
use tracing_subscriber::EnvFilter;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match arguments.command {
        Some(cli::Command::BuildChild) => match build_child::run() {
            true => ExitCode::SUCCESS,
            false => ExitCode::FAILURE,
        },
        Some(cli::Command::Serve(serve)) => finish(serve_until_stopped(&serve)),
        None => finish(serve_until_stopped(&arguments.serve)),
    }
}

fn finish(outcome: Result<(), ServerError>) -> ExitCode {
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            say(&format!("ERROR {}", error.to_string().replace('\n', "; ")));
            eprintln!("pbgi-server: {error}");
            ExitCode::from(error.exit_code())
        }
    }
}

/// One line to whoever started us.
fn say(line: &str) {
    let mut stdout = std::io::stdout().lock();
    // Whoever started us may not listen.
    let _ = writeln!(stdout, "{line}").and_then(|()| stdout.flush());
}

fn serve_until_stopped(arguments: &ServeArguments) -> Result<(), ServerError> {
    if arguments.private {
        process::leave_the_session();
    }
    process::make_files_private();
    let options = arguments.options()?;
    make_directories(&[&options.runtime_dir, &options.state_dir, &options.scratch_dir])?;
    let state = StateDir::take(&options.state_dir)?;
    // A stale segment would count as used memory.
    state.sweep_segment()?;
    let config = Config::new(options, &Machine::probe()?)?;
    if arguments.private {
        process::log_to(&config.options.log_file())?;
    }
    init_tracing(arguments)?;
    process::abort_on_core_panic();
    process::prefer_to_live();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(cli::RUNTIME_THREADS)
        .enable_all()
        .build()
        .map_err(|error| ServerError::Setup {
            action: "start the runtime",
            reason: error.to_string(),
        })?;
    let outcome = runtime.block_on(async {
        let listeners = Listeners::bind(&config)?;
        process::make_outputs_readable();
        let stop = stop_on_signals()?;
        let private = arguments.private;
        let ready = || {
            say("READY");
            if private {
                process::detach_stdout();
            }
        };
        pbgi_server::run(config, state, listeners, ready, stop).await
    });
    // Blocking tasks that still run belong to jobs that are given up.
    runtime.shutdown_background();
    outcome
}

/// The first signal drains, the second ends.
fn stop_on_signals() -> Result<watch::Receiver<Stop>, ServerError> {
    let listen = |kind| {
        signal(kind).map_err(|error| ServerError::Setup {
            action: "listen for signals",
            reason: error.to_string(),
        })
    };
    let mut terminate = listen(SignalKind::terminate())?;
    let mut interrupt = listen(SignalKind::interrupt())?;
    let mut hangup = listen(SignalKind::hangup())?;
    let (sender, receiver) = watch::channel(Stop::Run);
    tokio::spawn(async move {
        for stop in [Stop::Drain, Stop::Now] {
            tokio::select! {
                _ = terminate.recv() => {}
                _ = interrupt.recv() => {}
                _ = hangup.recv() => {}
            }
            sender.send_replace(stop);
        }
        sender.closed().await;
    });
    Ok(receiver)
}

fn init_tracing(arguments: &ServeArguments) -> Result<(), ServerError> {
    let filter = EnvFilter::try_new(&arguments.log).map_err(|error| ServerError::Option {
        name: "--log",
        value: arguments.log.clone(),
        expected: format!("a filter like info or pbgi_server=debug ({error})"),
    })?;
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr);
    match arguments.log_format {
        LogFormat::Text => subscriber.with_ansi(false).init(),
        LogFormat::Json => subscriber.json().init(),
    }
    Ok(())
}
