//! Runs a program of other people: its output into a log file.

use std::ffi::{OsStr, OsString};
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use anyhow::{Context, bail};

use crate::exit_code::Interrupted;

const NUM_LAST_LINES: usize = 5;
const POLL: Duration = Duration::from_millis(200);

pub(crate) struct Tool<'a> {
    pub name: &'static str,
    /// Debian's package with the program.
    pub package: &'static str,
    /// Receives the command lines and the output.
    pub log: PathBuf,
    pub stop: &'a AtomicBool,
}

impl Tool<'_> {
    /// Returns the standard output of a call that takes no time.
    pub fn output(&self, args: &[&OsStr]) -> anyhow::Result<String> {
        let output = Command::new(self.name).args(args).stdin(Stdio::null()).stderr(Stdio::null()).output();
        Ok(String::from_utf8_lossy(&self.started(output)?.stdout).into_owned())
    }

    /// Runs the program to its end.
    ///
    /// Where this process is killed, the pipe closes, so that the program ends at its next line.
    pub fn run(&self, args: &[OsString]) -> anyhow::Result<()> {
        let logging = || format!("writing {}", self.log.display());
        let mut log = OpenOptions::new().create(true).append(true).open(&self.log).with_context(logging)?;
        let words: Vec<_> = args.iter().map(|word| word.to_string_lossy()).collect();
        writeln!(log, "\n$ {} {}", self.name, words.join(" ")).with_context(logging)?;
        let (reader, writer) = std::io::pipe().context("opening a pipe")?;
        let mut command = Command::new(self.name);
        command.args(args).stdin(Stdio::null());
        command.stdout(writer.try_clone().context("opening a pipe")?).stderr(writer);
        let mut child = self.started(command.spawn())?;
        drop(command); // its end of the pipe
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            let pieces = BufReader::new(reader).split(b'\n').map_while(Result::ok);
            pieces.map(|line| String::from_utf8_lossy(&line).into_owned()).try_for_each(|line| sender.send(line))
        });
        loop {
            match lines.recv_timeout(POLL) {
                Ok(line) => writeln!(log, "{line}").with_context(logging)?,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if self.stop.load(Ordering::SeqCst) {
                // It may have ended by itself: Ctrl-C reaches both processes.
                drop(child.kill());
                drop(child.wait());
                return Err(Interrupted.into());
            }
        }
        let status = child.wait().with_context(|| format!("waiting for {}", self.name))?;
        if status.success() {
            return Ok(());
        }
        if self.stop.load(Ordering::SeqCst) {
            return Err(Interrupted.into());
        }
        bail!("{} ended with {status}: {}; its output: {}", self.name, last_lines(&self.log), self.log.display());
    }

    fn started<T>(&self, result: std::io::Result<T>) -> anyhow::Result<T> {
        match result {
            Err(error) if error.kind() == ErrorKind::NotFound => bail!(
                "`{}` is not on the PATH; install it: the package {} of Debian, Ubuntu, Homebrew and conda-forge",
                self.name,
                self.package
            ),
            result => result.with_context(|| format!("starting {}", self.name)),
        }
    }
}

fn last_lines(log: &Path) -> String {
    let lines = File::open(log).map(|file| BufReader::new(file).lines().map_while(Result::ok).collect::<Vec<_>>());
    let lines: Vec<_> = lines.unwrap_or_default().into_iter().filter(|line| !line.trim().is_empty()).collect();
    lines[lines.len().saturating_sub(NUM_LAST_LINES)..].join(" / ")
}
