//! The commands, one module each, and what they share: arguments, failures, files, progress, summaries.

mod answer;
mod args;
mod cache;
mod composite;
mod daemon;
mod diff;
mod failure;
mod files;
mod filter;
mod frame;
mod generate;
mod interrupt;
mod jobs;
mod look;
mod mesh;
mod progress;
mod render;
mod scenes;
mod session;
mod summary;
mod view;

use clap::{CommandFactory, Parser, Subcommand};
use failure::Failure;
use interrupt::Interrupt;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  pbgi-client demo
      A scene made on the spot: demo.exr, demo.png and the statistics.
  pbgi-client render kitchen.glb -o kitchen.exr --png kitchen.png --size 1280x720
      One command from a mesh with lights to a picture.
  pbgi-client build cloud.ply -o cloud.pbgi --memory 4G
  pbgi-client gbuffer kitchen.glb --camera 0 --size 1920x1080 -o g.exr
  pbgi-client shade cloud.pbgi --gbuffer g.exr -o indirect.exr --stats indirect.json
      The same in steps; the G-buffer may be another renderer's P and N passes.

Nothing needs to be set up: a command that finds no daemon starts a private one, which leaves when it has been idle.
Exit codes: 0 done; 1 failed (diff: the pictures differ by more than the threshold); 2 wrong usage (diff: or no two pictures to
compare); 130 interrupted.";

/// Global illumination for scenes larger than memory: point clouds and meshes in, irradiance and occlusion out.
#[derive(Debug, Parser)]
#[command(name = "pbgi-client", version, max_term_width = 110, after_help = EXAMPLES)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Render a scene made on the spot: demo.exr, demo.png and the statistics
    Demo(render::DemoArgs),
    /// Render a mesh with its lights: sample, build, G-buffer, shade and composite in one command
    Render(render::RenderArgs),
    /// Turn a mesh and its lights into lit points
    Sample(mesh::SampleArgs),
    /// Make a procedural scene of any size: a tree, a head of hair, a city, a forest
    Generate(generate::GenerateArgs),
    /// Render what a camera sees of a mesh: positions, normals, albedo, direct light
    Gbuffer(mesh::GbufferArgs),
    /// Build the octree of a scene from meshes or point clouds
    Build(jobs::BuildArgs),
    /// Shade a G-buffer, or what a camera sees, with a built scene
    Shade(jobs::ShadeArgs),
    /// Show a built scene: its points in the light of the sky and of each other
    View(view::ViewArgs),
    /// Bake occlusion and irradiance onto the points of a cloud
    Filter(filter::FilterArgs),
    /// Compare two pictures layer by layer
    Diff(diff::DiffArgs),
    /// Describe a built scene
    Info(daemon::InfoArgs),
    /// Show the daemon: memory, workers, open scenes
    Status(daemon::StatusArgs),
    /// Show the daemon's page cache: what it holds for which scene, who pins it, how often it had what was asked for
    Cache(cache::CacheArgs),
    /// List the daemon's jobs, newest first
    Jobs(jobs::ListArgs),
    /// Follow a job to its end
    Watch(jobs::WatchArgs),
    /// Cancel a job
    Cancel(jobs::CancelArgs),
    /// Let a job rest; its finished tiles are kept
    Pause(jobs::CancelArgs),
    /// Let a paused job go on
    Resume(jobs::JobNameArgs),
    /// Put a job that failed or was cancelled back in line
    Retry(jobs::JobNameArgs),
    /// Print completions for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
    /// Write the manual pages into a directory
    Man {
        /// The directory
        directory: std::path::PathBuf,
    },
    /// Stop the daemon once it has finished what is leased
    Shutdown(daemon::ShutdownArgs),
}

/// Runs a command to its end and says how it went.
pub(crate) fn run(arguments: Arguments) -> ExitCode {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build();
    let result = match runtime {
        Ok(runtime) => {
            let result = runtime.block_on(async {
                let interrupt = Interrupt::listen()?;
                dispatch(arguments.command, &interrupt).await
            });
            // A picture that was being made when the user lost patience must not keep the command.
            runtime.shutdown_background();
            result
        }
        Err(error) => Err(Failure::failed(format!(
            "cannot start the asynchronous runtime: {error}"
        ))),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            answer::note(format_args!("error: {failure}"));
            failure.exit_code()
        }
    }
}

async fn dispatch(command: Command, interrupt: &Interrupt) -> Result<(), Failure> {
    match command {
        Command::Demo(args) => render::demo(args, interrupt).await,
        Command::Render(args) => render::render(args, interrupt).await,
        Command::Sample(args) => mesh::sample(args, interrupt).await,
        Command::Generate(args) => generate::generate(args, interrupt).await,
        Command::Gbuffer(args) => mesh::gbuffer(args, interrupt).await,
        Command::Build(args) => jobs::build(args, interrupt).await,
        Command::Shade(args) => jobs::shade(args, interrupt).await,
        Command::View(args) => view::view(args, interrupt).await,
        Command::Filter(args) => filter::filter(args, interrupt).await,
        Command::Diff(args) => diff::diff(args, interrupt).await,
        Command::Info(args) => daemon::info(args, interrupt).await,
        Command::Status(args) => daemon::status(args, interrupt).await,
        Command::Cache(args) => cache::cache(args, interrupt).await,
        Command::Jobs(args) => jobs::list(args, interrupt).await,
        Command::Watch(args) => jobs::watch(args, interrupt).await,
        Command::Cancel(args) => jobs::cancel(args, interrupt).await,
        Command::Pause(args) => jobs::pause(args, interrupt).await,
        Command::Resume(args) => jobs::resume(args, interrupt).await,
        Command::Retry(args) => jobs::retry(args, interrupt).await,
        Command::Completions { shell } => {
            clap_complete::generate(shell, &mut Arguments::command(), "pbgi-client", &mut std::io::stdout());
            Ok(())
        }
        Command::Man { directory } => clap_mangen::generate_to(Arguments::command(), &directory).map_err(|error| {
            Failure::failed(format!(
                "cannot write manual pages: {error}, at {}",
                directory.display()
            ))
        }),
        Command::Shutdown(args) => daemon::shutdown(args, interrupt).await,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn every_command_of_the_contract_is_there() {
        let command = Arguments::command();
        for name in [
            "demo", "render", "sample", "generate", "gbuffer", "build", "shade", "view", "filter", "diff", "info",
            "status", "jobs", "watch", "cancel", "pause", "resume", "retry", "shutdown",
        ] {
            assert!(command.find_subcommand(name).is_some(), "{name}");
        }
    }

    fn fails(line: &str) -> String {
        let words = line.split_whitespace();
        Arguments::try_parse_from(words).unwrap_err().to_string()
    }

    #[test]
    fn a_named_server_has_its_own_memory() {
        let text = fails("pbgi-client info a.pbgi --server unix:/s --memory 2G");
        assert!(text.contains("--memory"), "{text}");
    }

    #[test]
    fn points_and_spacing_exclude_each_other() {
        let text = fails("pbgi-client build a.glb -o a.pbgi --points 10 --spacing 0.1");
        assert!(text.contains("--spacing"), "{text}");
    }

    #[test]
    fn nonsense_values_are_named() {
        assert!(fails("pbgi-client info a.pbgi --memory much").contains("2G"));
        assert!(fails("pbgi-client gbuffer a.glb -o g.exr --size big").contains("1920x1080"));
        assert!(fails("pbgi-client shade a.pbgi --gbuffer g.exr -o o.exr --max-dist far").contains("--max-dist"));
        assert!(fails("pbgi-client render a.glb -o o.exr --points -5").contains("--points"));
    }
}
