//! Progress of a job: a bar on a terminal, a line now and then elsewhere. All of it goes to standard error.

use super::answer::note;
use indicatif::{ProgressBar, ProgressStyle};
use pbgi_client::{Job, JobState};
use std::io::IsTerminal;
use std::time::{Duration, Instant};

const TICK: Duration = Duration::from_millis(120);
/// Steps between two plain lines of one stage, in percent.
const PLAIN_STEP: u64 = 25;

/// Shows what a job, or this process, is doing.
pub(crate) struct Progress {
    bar: Option<ProgressBar>,
    stage: String,
    started: Instant,
    step: Option<u64>,
}

impl Progress {
    pub(crate) fn new() -> Self {
        let bar = std::io::stderr().is_terminal().then(ProgressBar::new_spinner);
        if let Some(bar) = &bar {
            bar.enable_steady_tick(TICK);
        }
        Self {
            bar,
            stage: String::new(),
            started: Instant::now(),
            step: None,
        }
    }

    /// What happens now, without a measure.
    pub(crate) fn stage(&mut self, stage: &str) {
        self.show(stage, 0, 0);
    }

    /// Where a job stands.
    pub(crate) fn job(&mut self, job: &Job) {
        match job.state {
            JobState::Queued => self.show("waiting for its turn", 0, 0),
            JobState::Running => self.show(&job.stage, job.done, job.total),
            JobState::Succeeded | JobState::Failed | JobState::Cancelled => {}
        }
    }

    /// `done` of `total` units; a `total` of 0 is unknown.
    pub(crate) fn show(&mut self, stage: &str, done: u64, total: u64) {
        let stage = if stage.is_empty() { "working" } else { stage };
        let changed = self.stage != stage;
        if changed {
            self.stage = stage.to_owned();
            self.started = Instant::now();
            self.step = None;
        }
        match &self.bar {
            Some(bar) => {
                if changed || bar.length() != Some(total).filter(|&total| total > 0) {
                    restyle(bar, stage, total);
                }
                bar.set_position(done);
            }
            None => self.plain(done, total),
        }
    }

    /// A line that stays, above the bar.
    pub(crate) fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| note(format_args!("{text}"))),
            None => note(format_args!("{text}")),
        }
    }

    fn plain(&mut self, done: u64, total: u64) {
        let step = (done.min(total) * 100)
            .checked_div(total)
            .map(|percent| percent / PLAIN_STEP);
        let first = self.step.is_none();
        if !first && step <= self.step {
            return;
        }
        self.step = step.or(Some(0));
        match step {
            Some(step) if !first => {
                let pace = pace(done, total, self.started.elapsed().as_secs_f64());
                note(format_args!("{}: {} %{pace}", self.stage, step * PLAIN_STEP));
            }
            _ if first => note(format_args!("{} ...", self.stage)),
            _ => {}
        }
    }
}

/// How fast a stage goes and how long it will take, once that is worth knowing.
fn pace(done: u64, total: u64, seconds: f64) -> String {
    const WORTH_SECS: f64 = 5.0;
    if seconds < WORTH_SECS || done >= total {
        return String::new();
    }
    let rate = done as f64 / seconds;
    let left = (total - done) as f64 / rate;
    format!(", {rate:.0} a second, {left:.0} s left")
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn restyle(bar: &ProgressBar, stage: &str, total: u64) {
    let template = if total > 0 {
        "{spinner} {msg:12} {wide_bar} {percent:>3} %  {per_sec:>12}  {eta:>4}"
    } else {
        "{spinner} {msg}  {elapsed}"
    };
    match total {
        0 => bar.unset_length(),
        total => bar.set_length(total),
    }
    bar.reset_eta();
    // The templates are constants; a wrong one leaves the bar as it was.
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style);
    }
    bar.set_message(stage.to_owned());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_stage_tells_its_pace() {
        assert_eq!(pace(50, 200, 10.0), ", 5 a second, 30 s left");
        assert_eq!(pace(50, 200, 1.0), "");
        assert_eq!(pace(200, 200, 10.0), "");
    }
}
