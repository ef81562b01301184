//! Reads of the device per training step: during each read the GPU idles until the host queues more work.

use std::sync::atomic::{AtomicUsize, Ordering};

use burn::tensor::Device;
use clift_train::Stage;
use log::{LevelFilter, Log, Metadata, Record};

use crate::gpu;
use crate::place::{Place, values};
use crate::updates::{batch, learner, step};

/// Counts the buffers that are mapped for reading, from the log of wgpu.
struct CountReads;

static NUM_READS: AtomicUsize = AtomicUsize::new(0);

impl Log for CountReads {
    fn enabled(&self, metadata: &Metadata) -> bool {
        metadata.target().starts_with("wgpu_core")
    }

    fn log(&self, record: &Record) {
        if self.enabled(record.metadata()) && record.args().to_string().starts_with("Buffer::map_async") {
            NUM_READS.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn flush(&self) {}
}

/// Reads of the device while `work` runs.
fn count<T>(device: &Device, work: impl FnOnce() -> T) -> (T, usize) {
    // A second test of this process may have been first.
    let _ = log::set_logger(&CountReads);
    device.sync().expect("the device works");
    NUM_READS.store(0, Ordering::Relaxed);
    log::set_max_level(LevelFilter::Trace);
    let result = work();
    log::set_max_level(LevelFilter::Off);
    (result, NUM_READS.load(Ordering::Relaxed))
}

#[test]
fn a_training_step_reads_from_the_device_once() {
    let Some((gpu, _guard)) = gpu() else { return };
    let place = Place::new(&gpu);
    let one = place.random([3], 1).inner();
    assert_eq!(count(&gpu, || values(one.clone())).1, 1, "a read is counted");
    assert_eq!(count(&gpu, || (one.clone() + 1, gpu.sync())).1, 0, "work alone is not");

    for (name, stage, parts, recompute) in [
        ("stage 1", Stage::Stage1, 1, false),
        ("stage 1 two micro-batches, activation checkpointing", Stage::Stage1, 2, true),
        ("stage 2", Stage::Stage2, 1, false),
    ] {
        let batch = batch(&place, stage);
        // The first step measures kernels, reading times and results.
        let (learner, _) = step(learner(&place, stage, recompute), &batch, parts);
        let ((learner, _), first) = count(&gpu, || step(learner, &batch, parts));
        let (_, second) = count(&gpu, || step(learner, &batch, parts));
        println!("{name}: {first} and {second} reads in a step");
        assert_eq!([first, second], [1, 1], "{name}: loss and gradient norm, together");
    }
}
