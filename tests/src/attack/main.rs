//! Attacks every reader with damaged files: `bash scripts/check/attack.sh` (docs/results/robustness.md).
//!
//! Starts from valid files, mutates them, and reads each. A reader may accept or refuse; it may not panic, hang, exceed
//! its bound of memory, or refuse without a message. An execution is a function of (reader, seed, number):
//! `clift-attack --target NAME --seed S --first NUMBER --count 1` repeats it.

mod counting;
mod mutate;
mod readers;
mod report;
mod setup;
mod targets;
mod watch;
mod words;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use clap::Parser;
use clap::builder::PossibleValuesParser;
use mutate::Mutator;
use report::Attacked;
use setup::Setup;
use targets::{TARGETS, Target};

/// Longest execution in seconds: no valid input takes a hundredth of it.
const MOST_SECONDS: u64 = 10;

/// Attacks readers with damaged files.
#[derive(Debug, Parser)]
struct Args {
    /// The reader; all of them by default
    #[arg(long, value_name = "NAME", value_parser = PossibleValuesParser::new(TARGETS.iter().map(|target| target.name)))]
    target: Vec<String>,
    /// Seconds for each reader
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// Decides every mutation
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Number of the first execution
    #[arg(long, default_value_t = 0)]
    first: u64,
    /// Most executions of each reader
    #[arg(long)]
    count: Option<u64>,
    /// Folder for inputs that found something
    #[arg(long, value_name = "DIR", default_value = "findings")]
    findings: PathBuf,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let setup = match Setup::make() {
        Ok(setup) => setup,
        Err(error) => {
            eprintln!("making the valid files failed: {error}");
            return ExitCode::FAILURE;
        }
    };
    let messages = hush_panics();
    watch::start(Duration::from_secs(MOST_SECONDS));
    let chosen = TARGETS.iter().filter(|target| args.target.is_empty() || args.target.iter().any(|n| n == target.name));
    let mut findings = 0;
    for target in chosen {
        let row = attack(target, &setup, &args, &messages);
        println!("{}", row.line());
        findings += row.findings.len();
    }
    if findings > 0 {
        println!("{findings} findings; their inputs are in {}", args.findings.display());
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}

type Messages = Arc<Mutex<Option<String>>>;

/// Keeps the first line of a panic instead of printing it.
fn hush_panics() -> Messages {
    let messages = Messages::default();
    let noted = messages.clone();
    std::panic::set_hook(Box::new(move |info| {
        let text = info.payload_as_str().unwrap_or("no message").lines().next().unwrap_or_default().to_owned();
        let place = info.location().map(|place| format!(" at {}:{}", place.file(), place.line())).unwrap_or_default();
        noted.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(format!("{text}{place}"));
    }));
    messages
}

fn attack(target: &Target, setup: &Setup, args: &Args, messages: &Messages) -> Attacked {
    let seeds = (target.seeds)(setup, target.file);
    let mut read = (target.open)(setup, target.file);
    let mut row = Attacked { name: target.name, ..Attacked::default() };
    for (i, seed) in seeds.iter().enumerate() {
        if let Err(error) = read(seed) {
            row.find(format!("valid file {i} is refused: {error}"), None);
        }
    }
    let words = words::list(target.words);
    let mutator = Mutator { seeds: &seeds, words: &words, repair: target.repair };
    let started = Instant::now();
    for number in args.first..args.first.saturating_add(args.count.unwrap_or(u64::MAX)) {
        if started.elapsed().as_secs_f64() >= args.seconds || row.findings.len() >= report::MOST_FINDINGS {
            break;
        }
        let bytes = mutator.input(target.name, args.seed, number);
        let found = execute(&mut read, &bytes, target, number, args.seed, messages, &mut row);
        if let Some(what) = found {
            let name = format!("{}-{}-{number}", target.name, args.seed);
            let saved = std::fs::create_dir_all(&args.findings)
                .and_then(|()| std::fs::write(args.findings.join(&name), &bytes))
                .map_or_else(|error| format!("not saved: {error}"), |()| name);
            row.find(what, Some(saved));
        }
    }
    row.seconds = started.elapsed().as_secs_f64();
    row
}

fn execute(
    read: &mut readers::Read,
    bytes: &[u8],
    target: &Target,
    number: u64,
    seed: u64,
    messages: &Messages,
    row: &mut Attacked,
) -> Option<String> {
    messages.lock().unwrap_or_else(PoisonError::into_inner).take();
    let most = (target.most_bytes)(bytes.len());
    watch::enter(target.name, seed, number);
    let before = counting::start();
    let started = Instant::now();
    // The files of the next input replace any that an unwound reader left half done.
    let result = catch_unwind(AssertUnwindSafe(|| read(bytes)));
    let (elapsed, peak) = (started.elapsed(), counting::peak().saturating_sub(before));
    watch::leave();
    row.executions += 1;
    row.slowest = row.slowest.max(elapsed);
    row.peak_bytes = row.peak_bytes.max(peak);
    if peak > most {
        return Some(format!("{peak} bytes for an input of {}, at most {most} expected", bytes.len()));
    }
    match result {
        Err(_) => {
            let message = messages.lock().unwrap_or_else(PoisonError::into_inner).take();
            Some(format!("panicked: {}", message.unwrap_or_default()))
        }
        Ok(Ok(())) => {
            row.accepted += 1;
            None
        }
        Ok(Err(message)) if message.trim().is_empty() => Some("refused without a word".into()),
        Ok(Err(message)) if message.len() > report::MOST_MESSAGE => {
            Some(format!("refused with {} bytes of words: {:.80}..", message.len(), message))
        }
        Ok(Err(_)) => None,
    }
}
