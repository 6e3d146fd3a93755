//! The `pbgi-server` program.
#![forbid(unsafe_code)]

mod cli;
#[cfg(feature = "otlp")]
mod otlp;
mod process;

use clap::{CommandFactory, Parser};
use cli::{Arguments, LogFormat, ServeArguments};
use pbgi_server::budget::Machine;
use pbgi_server::config_file::ConfigFile;
use pbgi_server::state::{StateDir, make_directories};
use pbgi_server::supervisor::abort_on_core_panic;
use pbgi_server::{Config, Life, Listeners, Options, Orders, ServerError, Stop, build_child};
use std::io::Write;
use std::process::ExitCode;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, Registry, reload};

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match arguments.command {
        Some(cli::Command::BuildChild) => match build_child::run() {
            true => ExitCode::SUCCESS,
            false => ExitCode::FAILURE,
        },
        Some(cli::Command::Serve(serve)) => finish(serve_until_stopped(&serve)),
        Some(cli::Command::Check(serve)) => finish(check(&serve)),
        Some(cli::Command::Man { directory }) => finish(write_manual(&directory)),
        Some(cli::Command::Completions { shell }) => {
            clap_complete::generate(shell, &mut Arguments::command(), "pbgi-server", &mut std::io::stdout());
            ExitCode::SUCCESS
        }
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

fn check(arguments: &ServeArguments) -> Result<(), ServerError> {
    let config = Config::new(arguments.options(&arguments.file()?)?, &Machine::probe()?)?;
    for line in config.explain() {
        say(&line);
    }
    Ok(())
}

fn write_manual(directory: &std::path::Path) -> Result<(), ServerError> {
    let written = clap_mangen::generate_to(Arguments::command(), directory);
    written.map_err(|source| ServerError::Io {
        action: "write manual pages",
        path: directory.to_owned(),
        source,
    })
}

fn serve_until_stopped(arguments: &ServeArguments) -> Result<(), ServerError> {
    if arguments.private {
        process::leave_the_session();
    }
    process::make_files_private();
    let activated = process::activated_socket()?;
    let file = arguments.file()?;
    let options = arguments.options(&file)?;
    make_directories(&[&options.runtime_dir, &options.state_dir, &options.scratch_dir])?;
    let state = StateDir::take(&options.state_dir)?;
    // A stale segment would count as used memory.
    state.sweep_segment()?;
    let config = Config::new(options, &Machine::probe()?)?;
    if arguments.private {
        process::log_to(&config.options.log_file())?;
    }
    abort_on_core_panic();
    process::prefer_to_live();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(cli::RUNTIME_THREADS)
        .enable_all()
        .build()
        .map_err(|error| ServerError::Setup {
            action: "start the runtime",
            reason: error.to_string(),
        })?;
    let within = runtime.enter();
    let (log, traces) = init_tracing(arguments, &file, &config)?;
    drop(within);
    let outcome = runtime.block_on(async {
        let listeners = Listeners::bind(&config, activated)?;
        process::make_outputs_readable();
        let orders = obey_signals(arguments.clone(), log)?;
        let private = arguments.private;
        let tell = |life| {
            process::tell_service_manager(life);
            if life == Life::Ready {
                say("READY");
                if private {
                    process::detach_stdout();
                }
            }
        };
        pbgi_server::run(config, state, listeners, tell, orders).await
    });
    traces.finish();
    // Blocking tasks that still run belong to jobs that are given up.
    runtime.shutdown_background();
    outcome
}

/// The first signal drains, the second ends. SIGHUP reads the configuration file again if there is one.
fn obey_signals(arguments: ServeArguments, log: LogHandle) -> Result<Orders, ServerError> {
    let listen = |kind| {
        signal(kind).map_err(|error| ServerError::Setup {
            action: "listen for signals",
            reason: error.to_string(),
        })
    };
    let mut terminate = listen(SignalKind::terminate())?;
    let mut interrupt = listen(SignalKind::interrupt())?;
    let mut hangup = listen(SignalKind::hangup())?;
    let (sender, stop) = watch::channel(Stop::Run);
    let (options, reload) = watch::channel(None);
    tokio::spawn(async move {
        for stop in [Stop::Drain, Stop::Now] {
            loop {
                tokio::select! {
                    _ = terminate.recv() => break,
                    _ = interrupt.recv() => break,
                    _ = hangup.recv() => match arguments.config {
                        Some(_) => match read_again(&arguments, &log) {
                            Ok(new) => drop(options.send_replace(Some(new))),
                            Err(error) => tracing::error!(%error, "the configuration stays as it was"),
                        },
                        None => break,
                    },
                }
            }
            sender.send_replace(stop);
        }
        sender.closed().await;
    });
    Ok(Orders { stop, reload })
}

/// Changes what is logged.
type LogHandle = reload::Handle<EnvFilter, Registry>;

fn log_filter(text: &str) -> Result<EnvFilter, ServerError> {
    EnvFilter::try_new(text).map_err(|error| ServerError::Option {
        name: "--log",
        value: text.to_owned(),
        expected: format!("a filter like info or pbgi_server=debug ({error})"),
    })
}

/// Where spans go.
struct Traces {
    #[cfg(feature = "otlp")]
    collector: Option<otlp::Traces>,
}

impl Traces {
    /// Sends what is left.
    fn finish(&self) {
        #[cfg(feature = "otlp")]
        self.collector.iter().for_each(otlp::Traces::finish);
    }
}

fn init_tracing(
    arguments: &ServeArguments,
    file: &ConfigFile,
    config: &Config,
) -> Result<(LogHandle, Traces), ServerError> {
    // A configuration with a collector is refused by a program without the feature.
    debug_assert!(cfg!(feature = "otlp") || config.options.otlp.is_none());
    let (filter, handle) = reload::Layer::new(log_filter(arguments.log(file))?);
    let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
    let lines = match arguments.log_format(file) {
        LogFormat::Text => lines.with_ansi(false).boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    let subscriber = tracing_subscriber::registry().with(lines.with_filter(filter));
    #[cfg(feature = "otlp")]
    let collector = config.options.otlp.as_deref().map(otlp::Traces::start).transpose()?;
    #[cfg(feature = "otlp")]
    let subscriber = subscriber.with(collector.as_ref().map(otlp::Traces::layer));
    subscriber.init();
    let traces = Traces {
        #[cfg(feature = "otlp")]
        collector,
    };
    Ok((handle, traces))
}

/// Reads the configuration file again and takes over what is logged; the rest is the daemon's.
fn read_again(arguments: &ServeArguments, log: &LogHandle) -> Result<Options, ServerError> {
    let file = arguments.file()?;
    let options = arguments.options(&file)?;
    let filter = log_filter(arguments.log(&file))?;
    let text = filter.to_string();
    let changed = log.with_current(|current| current.to_string() != text).unwrap_or(true);
    log.reload(filter).map_err(|error| ServerError::Setup {
        action: "change what is logged",
        reason: error.to_string(),
    })?;
    if changed {
        tracing::info!("from now on {text} is logged");
    }
    Ok(options)
}
