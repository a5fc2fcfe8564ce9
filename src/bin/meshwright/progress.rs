//! Progress: a bar on a terminal, 3D Slicer's tags on a pipe that asks for them, else nothing.
//!
//! # Method
//! Slicer polls the pipe, so each line is flushed. It asks by `--slicer-progress`, which its description of the
//! subcommand always sets; a process that Slicer's launcher started is recognised by `SLICER_HOME` too.

use std::io::{IsTerminal, Write};
use std::time::Instant;

use indicatif::{ProgressBar, ProgressStyle};

/// Smallest step of the fraction that is worth a line for Slicer.
const SLICER_STEP: f64 = 0.005;

/// Shows where a run is.
pub enum Progress {
    /// On a terminal.
    Bar(ProgressBar),
    /// Slicer's tags.
    Slicer {
        /// When the run began.
        begin: Instant,
        /// Fraction last told.
        told: f64,
        /// Stage last told.
        stage: &'static str,
        /// Name of the run.
        name: &'static str,
    },
    /// Nobody looks.
    None,
}

impl Progress {
    /// What suits the streams of this process.
    pub fn new(name: &'static str, slicer: bool, quiet: bool) -> Self {
        let started_by_slicer = std::env::var_os("SLICER_HOME").is_some() && !std::io::stdout().is_terminal();
        if slicer || (started_by_slicer && !quiet) {
            tell(&format!(
                "<filter-start>\n<filter-name>{name}</filter-name>\n<filter-comment>{name}</filter-comment>\n</filter-start>\n"
            ));
            return Self::Slicer { begin: Instant::now(), told: 0.0, stage: "", name };
        }
        if quiet || !std::io::stderr().is_terminal() {
            return Self::None;
        }
        let bar = ProgressBar::new(1000);
        let style = ProgressStyle::with_template("{wide_bar} {percent:>3}% {elapsed} {msg}");
        bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
        Self::Bar(bar)
    }

    /// Shows stage and fraction.
    pub fn show(&mut self, now: &'static str, fraction: f64) {
        match self {
            Self::Bar(bar) => {
                bar.set_position((fraction * 1000.0) as u64);
                bar.set_message(now);
            }
            Self::Slicer { told, stage, .. } => {
                if fraction - *told >= SLICER_STEP || now != *stage {
                    tell(&format!("<filter-progress>{fraction:.4}</filter-progress>\n"));
                    (*told, *stage) = (fraction, now);
                }
            }
            Self::None => {}
        }
    }

    /// Takes the bar away, closes the tags.
    pub fn finish(self) {
        match self {
            Self::Bar(bar) => bar.finish_and_clear(),
            Self::Slicer { begin, name, .. } => tell(&format!(
                "<filter-end>\n<filter-name>{name}</filter-name>\n<filter-time>{:.3}</filter-time>\n</filter-end>\n",
                begin.elapsed().as_secs_f64()
            )),
            Self::None => {}
        }
    }
}

fn tell(text: &str) {
    let mut stdout = std::io::stdout().lock();
    // A host that has closed the pipe does not look any more; the run goes on.
    let _ = stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush());
}
