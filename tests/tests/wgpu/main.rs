//! Results of a GPU (or Mesa's software Vulkan):
//! `cargo test --release --workspace --features wgsl --test wgpu_suite -- --nocapture` prints the errors.
//!
//! Without an adapter the tests are skipped; with `CLIFT_REQUIRE_WGPU` set they fail. `clift-cube` tests the kernels one by one.

mod no_adapter;
#[allow(dead_code)]
#[path = "../support.rs"]
mod support;
mod updates;

use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, MutexGuard, PoisonError};

use burn::tensor::{DType, Device, Tensor};
use clift_bench::{BenchCase, BenchOptions, CaseSize, run_bench, run_ledger, run_stability, stability_markdown};
use clift_model::{DeviceName, FlopConvention, Precision, TokenCount, adapters, max_tensor_bytes, observe_kernels};
use clift_scene::Scene;
use clift_train::{Config, read_config};

use crate::support::{BINARY, Place, WHOLE, repository};

/// The GPU, for one test at a time: the Vulkan loader fails when several threads open and close instances. `None` where there
/// is none and none is required.
fn gpu() -> Option<(Device, MutexGuard<'static, ()>)> {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    let guard = ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner);
    match DeviceName::Wgpu.open() {
        Ok(device) => Some((device, guard)),
        Err(error) => {
            support::skip("wgpu", &error.to_string());
            None
        }
    }
}

/// The config of the micro run with images of 16 x 24, so that swapped axes are detected, and more changed keys.
fn config(set: &[&str]) -> Config {
    let set: Vec<String> = ["data.width=24"].iter().chain(set).map(|&text| text.into()).collect();
    read_config(&repository("tests/micro.toml"), &set).expect("a valid config").0
}

#[test]
fn adapter_limits_hold_on_the_open_device() {
    let Some((device, _guard)) = gpu() else { return };
    let adapters = adapters();
    let used = adapters.iter().find(|adapter| adapter.is_used).expect("the device is one of them");
    let most = used.max_tensor_bytes;
    assert_eq!(max_tensor_bytes(&device), Some(most));
    assert_eq!(max_tensor_bytes(&device.clone().autodiff()), Some(most), "with autodiff as without");
    assert_eq!(device.supports_dtype(DType::F16), used.has_f16);
    assert_eq!(Precision::F16.check("precision", &device).is_ok(), used.has_f16);

    // A tensor of the reported size (at most 128 MiB) can be made and read, as the checks before a run assume. (Burn's sum of
    // as many values is wrong on software Vulkan.)
    let len = (most.min(128 << 20) / 4) as usize;
    let values = Tensor::<1>::ones([len], &device).into_data();
    let values = values.as_slice::<f32>().expect("f32");
    assert_eq!((values.len(), values.iter().filter(|&&value| value == 1.0).count()), (len, len));
}

#[test]
fn every_part_of_the_method_is_close_to_f64() {
    let Some((_, _guard)) = gpu() else { return };
    let networks: [(&[&str], &[BenchCase]); 5] = [
        (&["model.condenser.num_blocks=2"], BenchCase::ALL),
        (&["model.condenser.residual=false"], &[BenchCase::Condense, BenchCase::Stage2Step]),
        (&["model.variant='released-re10k'"], &[BenchCase::Condense, BenchCase::Stage2Step]),
        (&["model.variant='released-dl3dv'"], &[BenchCase::Encode, BenchCase::Stage1Step, BenchCase::Stage2Step]),
        (&["model.camera_encoding='gta'"], &[BenchCase::Encode, BenchCase::Render, BenchCase::Stage2Step]),
    ];
    for (set, cases) in networks {
        let options = BenchOptions {
            cases: cases.into(),
            repeats: 1,
            warmup: 0,
            error: true,
            stored_tokens: TokenCount::Count(3),
        };
        let config = config(&[set, &["device='wgpu'"]].concat());
        let report = run_bench(&config, &options, &AtomicBool::new(false), &mut |_| ()).expect("runs");
        assert_eq!(report.rows.len(), cases.len());
        for row in report.rows {
            println!("{set:?}: {}: {:?}", row.case, row.max_rel_error);
            // As on the CPU: outputs to 1e-5, gradients to 5e-5.
            assert!(row.max_rel_error.is_some_and(|error| error < 1e-4), "{set:?}: {row:?}");
        }
    }
}

/// The launches of an update do not depend on sizes, only on the number of blocks: 6 + 6 in the paper.
#[test]
fn updates_launch_few_kernels_and_only_own_products() {
    let Some((device, _guard)) = gpu() else { return };
    let (values, kernels) = observe_kernels(true, || (Tensor::<1>::ones([300], &device) * 2.0).into_data());
    assert_eq!(values.as_slice::<f32>().expect("f32"), [2.0; 300], "timed kernels run");
    let measured = kernels.iter().filter_map(|kernel| kernel.seconds);
    assert!(kernels.iter().any(|kernel| kernel.count == 1) && measured.fold(0.0, f64::max) < 60.0, "{kernels:?}");

    let set = ["device='wgpu'", "model.num_encoder_blocks=6", "model.num_renderer_blocks=6"];
    let cases = vec![BenchCase::Encode, BenchCase::Stage1Step];
    let stored_tokens = TokenCount::Count(3);
    let options = BenchOptions { cases, repeats: 1, warmup: 1, error: false, stored_tokens };
    let ledger = run_ledger(&config(&set), &options, &AtomicBool::new(false), &mut |_| ()).expect("runs");
    for row in &ledger.rows {
        let kernels = row.kernels.iter().map(|kernel| (&*kernel.kernel, kernel.count, kernel.bytes));
        let of_burn: Vec<_> = kernels.clone().filter(|(name, ..)| name.starts_with("burn")).collect();
        println!("{}: {} launches, {} bytes; {of_burn:?}", row.case, row.count(), row.bytes());
        let products = of_burn.iter().filter(|(name, ..)| name.contains("matmul") || name.contains("attention"));
        assert_eq!(products.count(), 0, "{of_burn:?}");
        assert!(kernels.clone().any(|(name, _, bytes)| name.starts_with("attention") && bytes > Some(0)));
    }
    let Config { model, data, .. } = config(&set);
    let macs = model.encode_macs(data.views.max_context, data.height, data.width).expect("valid sizes");
    // No convention counts the rays: a 3 x 6 matrix by the direction of every pixel.
    let rays = (18 * data.views.max_context * data.height * data.width) as u64;
    assert_eq!(ledger.rows[0].flops(), 2 * (macs.count(FlopConvention::Macs) + rays), "the operations of encoding");
    let [encode, update] = [0, 1].map(|i| ledger.rows[i].count());
    assert!((60..300).contains(&encode) && (600..=1200).contains(&update), "{encode}, {update}");
}

#[test]
fn a_killed_run_ends_with_the_same_bytes() {
    let Some((_, _guard)) = gpu() else { return };
    let place = Place::new();
    for precision in ["f32", "f16"] {
        let [whole, parts] = ["whole", "parts"].map(|name| format!("{precision}-{name}"));
        let set = format!("precision='{precision}'");
        let train = |binary: &str, moment: Option<&str>, run: &str| {
            // `Place::train` hides the adapter.
            let args = place.train_args(run, &["device='wgpu'", &set]);
            Command::new(binary).args(moment).args(args).status().expect("it starts").code()
        };
        assert_eq!(train(BINARY, None, &whole), Some(0));
        for moment in ["step/stage1/3", "saved/stage2/2"] {
            assert_eq!(train(env!("CARGO_BIN_EXE_clift-killed"), Some(moment), &parts), None, "{moment}");
        }
        assert_eq!(train(BINARY, None, &parts), Some(0));
        for stage in ["stage1", "stage2"] {
            assert!(place.weights(&whole, stage) == place.weights(&parts, stage), "{precision}: {stage}");
        }
    }
}

#[test]
fn hard_cases_are_within_their_bounds() {
    let Some((_, _guard)) = gpu() else { return };
    let rows = run_stability(&[DeviceName::Wgpu], CaseSize::Small, &mut |_| ()).expect("the adapter opens");
    println!("{}", stability_markdown(&[DeviceName::Wgpu], &rows));
    let broken = rows.iter().filter(|row| !row.is_within_bound()).map(|row| (row.case.name, &row.outcomes));
    let broken: Vec<_> = broken.collect();
    assert!(broken.is_empty(), "{broken:?}");
}

#[test]
fn scenes_are_encoded_and_rendered_as_on_the_cpu() {
    let Some((_, _guard)) = gpu() else { return };
    let place = Place::with(&WHOLE);
    let run = |words: &str| {
        // `Place::clift` hides the adapter.
        let output = Command::new(BINARY).args(words.split(' ')).current_dir(place.at("")).output().expect("it starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    for device in ["flex", "wgpu"] {
        let encode =
            "encode run --scene synthetic-0-test-00000 --stored-tokens 4 --format f32 --precision f32 --set device=";
        run(&format!("{encode}{device} -o {device}.clift"));
        run(&format!(
            "render flex.clift --path orbit --frames 2 --render 3 --precision f32 --device {device} -o {device}"
        ));
    }
    let [cpu, gpu] = ["flex", "wgpu"].map(|name| Scene::read(&place.at(&format!("{name}.clift"))).expect("a scene").0);
    assert_eq!(gpu.token_ids, cpu.token_ids, "the same clusters");
    let largest = cpu.tokens.iter().fold(0.0, |most: f32, value| most.max(value.abs()));
    let worst = gpu.tokens.iter().zip(&cpu.tokens).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst <= 5e-5 * largest, "{worst} of {largest}");
    for frame in ["frame-00000.png", "frame-00001.png"] {
        let [cpu, gpu] =
            ["flex", "wgpu"].map(|name| image::open(place.at(name).join(frame)).expect("a frame").into_rgb8());
        assert!(cpu.as_raw().iter().zip(gpu.as_raw()).all(|(a, b)| a.abs_diff(*b) <= 1), "{frame}");
    }
    assert_eq!(place.json("wgpu/render.json")["tokens"], place.json("flex/render.json")["tokens"]);
}
