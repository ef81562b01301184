//! Order of frames, idle and closed tabs, and a measurement of the speed.

use std::time::Duration;

use clift_core::{median, p95};

use crate::support::{Place, STAGE_1, WHOLE};
use crate::viewer::tab::{Picture, Tab, Viewer};

/// Measures a scene: `CLIFT_VIEW_SCENE=room.clift cargo test --release --workspace viewer_speed -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement"]
fn viewer_speed() {
    let scene = std::env::var("CLIFT_VIEW_SCENE").expect("CLIFT_VIEW_SCENE names a scene file or run");
    let viewer = Viewer::start(&[&scene], &std::env::current_dir().expect("a folder"));
    let mut tab = Tab::open(&viewer);
    let stored = tab.scene["stored"].as_u64().expect("a count");
    println!("{} of {}, {stored} tokens", tab.scene["key"], tab.scene["size"]);
    println!("tokens  fps    latency ms: median  p95    render ms: median  p95    latency - render, p95");
    for tokens in [stored, (stored / 4).max(1)] {
        drop(pictures(&mut tab, tokens, 50));
        let rate = tab.frame_rate(tokens, 5.0);
        let all = pictures(&mut tab, tokens, 500);
        let latency: Vec<f64> = all.iter().map(|one| one.latency_ms).collect();
        let render: Vec<f64> = all.iter().map(Picture::render_ms).collect();
        let over: Vec<f64> = latency.iter().zip(&render).map(|(a, b)| a - b).collect();
        let numbers = [median(&latency), p95(&latency), median(&render), p95(&render), p95(&over)];
        println!(
            "{tokens:>6}  {rate:>5.0}  {:>18.2} {:>6.2} {:>18.2} {:>6.2} {:>22.2}",
            numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
        );
    }
}

fn pictures(tab: &mut Tab, tokens: u64, count: usize) -> Vec<Picture> {
    (0..count).map(|_| tab.picture(tokens)).collect()
}

#[test]
fn pictures_follow_cameras_and_token_counts_at_once() {
    let place = Place::with(&WHOLE);
    let viewer = Viewer::start(&["run"], &place.at(""));
    let mut tab = Tab::open(&viewer);
    let stored = tab.scene["stored"].as_u64().expect("a count");
    for i in 0..200 {
        let tokens = 1 + i % stored;
        assert_eq!(tab.picture(tokens).header["tokens"], tokens, "the next frame has the new count");
    }
}

#[test]
fn runs_in_training_are_shown_from_the_newest_checkpoint() {
    for (shared, stage) in [(&STAGE_1, "stage1"), (&WHOLE, "stage2")] {
        let place = Place::with(shared);
        let before = Tab::open(&Viewer::start(&["run"], &place.at(""))).scene["token_ids"].clone();
        std::fs::remove_file(place.at(&format!("run/{stage}/model.safetensors"))).expect("the weights of the stage");
        let viewer = Viewer::start(&["run"], &place.at(""));
        let mut tab = Tab::open(&viewer);
        assert_eq!(tab.scene["token_ids"], before);
        assert_eq!(tab.picture(2).header["tokens"], 2);
    }
}

#[test]
fn idle_and_closed_tabs_cost_nothing() {
    let place = Place::with(&WHOLE);
    let viewer = Viewer::start(&["run"], &place.at(""));
    let used = |viewer: &Viewer, seconds: f64| {
        let before = viewer.cpu_s();
        std::thread::sleep(Duration::from_secs_f64(seconds));
        viewer.cpu_s() - before
    };
    let mut tab = Tab::open(&viewer);
    drop(tab.picture(1));
    assert!(used(&viewer, 2.0) <= 0.02, "an idle tab");
    // Cameras without end, and a tab that goes away in the middle.
    tab.frame_rate(1, 0.5);
    tab.send_view(1);
    drop(tab);
    std::thread::sleep(Duration::from_secs(1));
    assert!(used(&viewer, 2.0) <= 0.02, "a closed tab");
}

#[test]
fn a_stalled_tab_gets_two_frames_and_then_the_latest_camera() {
    let place = Place::with(&WHOLE);
    let viewer = Viewer::start(&["run"], &place.at(""));
    let mut tab = Tab::open(&viewer);
    for seq in [1, 2] {
        tab.send_view(1);
        assert_eq!(tab.reply().0["seq"], seq);
    }
    for _ in 2..50 {
        tab.send_view(1);
    }
    // The server reads the cameras before the acknowledgement.
    tab.send(&serde_json::json!({"type": "ack", "seq": 1}));
    assert_eq!(tab.reply().0["seq"], 50, "no camera was rendered without acknowledgement");
}
