//! Attacks every reader with damaged files: `bash scripts/check/attack.sh` (docs/results/robustness.md).
//!
//! Starts from valid files, mutates them, and reads each. A reader may accept or refuse; it may not panic, hang, exceed
//! its bound of memory, or refuse without a message. An execution is a function of (reader, seed, number):
//! `clift-attack --target NAME --seed S --first NUMBER` repeats it first.

mod counting;
mod mutate;
mod readers;
mod setup;
mod targets;
mod words;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use clap::Parser;
use clap::builder::PossibleValuesParser;
use mutate::Mutator;
use readers::Read;
use setup::Setup;
use targets::{TARGETS, Target};

/// Longest execution: no valid input takes a hundredth of it.
const MOST_TIME: Duration = Duration::from_secs(10);
/// Findings after which the attack of a reader stops.
const MOST_FINDINGS: usize = 20;
/// Longest error message in bytes: people read it.
const MOST_MESSAGE: usize = 20_000;

/// Number of the present execution.
static NUMBER: AtomicU64 = AtomicU64::new(0);
/// Start of the present execution, and its reader.
static RUNNING: Mutex<Option<(Instant, &'static str)>> = Mutex::new(None);
/// First line of a panic.
static PANIC: Mutex<Option<String>> = Mutex::new(None);

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
    /// Folder for inputs that found something
    #[arg(long, value_name = "DIR", default_value = "findings")]
    findings: PathBuf,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let setup = Setup::make().unwrap_or_else(|error| {
        eprintln!("making the valid files failed: {error}");
        std::process::exit(1)
    });
    std::panic::set_hook(Box::new(|info| {
        let text = info.payload_as_str().unwrap_or("no message").lines().next().unwrap_or_default().to_owned();
        let place = info.location().map(|place| format!(" at {}:{}", place.file(), place.line())).unwrap_or_default();
        PANIC.lock().expect("no panic holds it").get_or_insert(format!("{text}{place}"));
    }));
    std::thread::spawn(end_where_one_hangs);
    let chosen = TARGETS.iter().filter(|target| args.target.is_empty() || args.target.iter().any(|n| n == target.name));
    let num_findings: usize = chosen.map(|target| attack(target, &setup, &args)).sum();
    if num_findings > 0 {
        println!("{num_findings} findings; their inputs are in {}", args.findings.display());
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}

fn number() -> u64 {
    NUMBER.load(Ordering::Relaxed)
}

/// Ends the process with the number of the execution that hangs.
fn end_where_one_hangs() {
    loop {
        std::thread::sleep(Duration::from_millis(200));
        if let Some((since, name)) = *RUNNING.lock().expect("no panic holds it")
            && since.elapsed() > MOST_TIME
        {
            eprintln!("{name}: execution {} hangs for more than {} s", number(), MOST_TIME.as_secs());
            std::process::exit(3);
        }
    }
}

/// Results of the executions of a reader.
#[derive(Default)]
struct Totals {
    executions: u64,
    accepted: u64,
    slowest: Duration,
    peak_bytes: usize,
}

/// Attacks a reader, prints a line and returns the number of findings.
fn attack(target: &Target, setup: &Setup, args: &Args) -> usize {
    let (seeds, mut read) = (target.open)(setup);
    let (mut totals, mut findings) = (Totals::default(), Vec::new());
    for (i, seed) in seeds.iter().enumerate() {
        if let Err(error) = read(seed) {
            findings.push(format!("valid file {i} is refused: {error}"));
        }
    }
    let words = words::list(target.words);
    let mutator = Mutator { seeds: &seeds, words: &words, repair: target.repair };
    let started = Instant::now();
    for number in args.first.. {
        if started.elapsed().as_secs_f64() >= args.seconds || findings.len() >= MOST_FINDINGS {
            break;
        }
        let bytes = mutator.input(target.name, args.seed, number);
        NUMBER.store(number, Ordering::Relaxed);
        let found = execute(&mut read, &bytes, target, &mut totals).err();
        // Each once.
        if let Some(what) = found.filter(|what| findings.iter().all(|known| !known.starts_with(what))) {
            let name = format!("{}-{}-{number}", target.name, args.seed);
            let saved = std::fs::create_dir_all(&args.findings)
                .and_then(|()| std::fs::write(args.findings.join(&name), &bytes))
                .map_or_else(|error| format!("not saved: {error}"), |()| name);
            findings.push(format!("{what} ({saved})"));
        }
    }
    let Totals { executions, accepted, slowest, peak_bytes } = totals;
    println!(
        "{}: {executions} executions in {:.0} s, {accepted} accepted, slowest {:.1} ms, peak {:.1} MiB",
        target.name,
        started.elapsed().as_secs_f64(),
        slowest.as_secs_f64() * 1e3,
        peak_bytes as f64 / f64::from(1 << 20)
    );
    for finding in &findings {
        println!("  FOUND: {finding}");
    }
    findings.len()
}

/// Reads an input; the error is what the reader may not do.
fn execute(read: &mut Read, bytes: &[u8], target: &Target, totals: &mut Totals) -> Result<(), String> {
    let set_running = |running| *RUNNING.lock().expect("no panic holds it") = running;
    set_running(Some((Instant::now(), target.name)));
    PANIC.lock().expect("no panic holds it").take();
    let before = counting::start();
    let started = Instant::now();
    // The files of the next input replace any that an unwound reader left half done.
    let result = catch_unwind(AssertUnwindSafe(|| read(bytes)));
    let (elapsed, peak) = (started.elapsed(), counting::peak().saturating_sub(before));
    set_running(None);
    totals.executions += 1;
    totals.slowest = totals.slowest.max(elapsed);
    totals.peak_bytes = totals.peak_bytes.max(peak);
    let most = (target.most_bytes)(bytes.len());
    if peak > most {
        return Err(format!("{peak} bytes for an input of {}, at most {most} expected", bytes.len()));
    }
    match result {
        Err(_) => Err(format!("panicked: {}", PANIC.lock().expect("no panic holds it").take().unwrap_or_default())),
        Ok(Err(message)) if message.trim().is_empty() => Err("refused without a word".into()),
        Ok(Err(message)) if message.len() > MOST_MESSAGE => {
            Err(format!("refused with {} bytes of words: {message:.80}..", message.len()))
        }
        Ok(read) => {
            totals.accepted += u64::from(read.is_ok());
            Ok(())
        }
    }
}
