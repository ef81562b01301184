//! Order of frames, idle and closed tabs.

use std::time::Duration;

use crate::support::{Place, STAGE_1, WHOLE};
use crate::viewer::tab::{Tab, Viewer};

#[test]
fn runs_in_training_are_shown_from_the_newest_checkpoint() {
    for (shared, stage) in [(&STAGE_1, "stage1"), (&WHOLE, "stage2")] {
        let place = Place::with(shared);
        let before = Tab::open(&Viewer::start(&["run"], &place.at(""))).scene["token_ids"].clone();
        std::fs::remove_file(place.at(&format!("run/{stage}/model.safetensors"))).expect("the weights of the stage");
        let viewer = Viewer::start(&["run"], &place.at(""));
        let mut tab = Tab::open(&viewer);
        assert_eq!(tab.scene["token_ids"], before);
        assert_eq!(tab.picture(2)["tokens"], 2);
    }
}

#[test]
fn pictures_follow_cameras_and_counts_at_once_and_idle_or_closed_tabs_cost_nothing() {
    let place = Place::with(&WHOLE);
    let viewer = Viewer::start(&["run"], &place.at(""));
    let idle = |what: &str| {
        let before = viewer.cpu_s();
        std::thread::sleep(Duration::from_secs(2));
        let used = viewer.cpu_s() - before;
        assert!(used <= 0.02, "{what}: {used} s");
    };
    let mut tab = Tab::open(&viewer);
    let stored = tab.scene["stored"].as_u64().expect("a count");
    for i in 0..200 {
        let tokens = 1 + i % stored;
        assert_eq!(tab.picture(tokens)["tokens"], tokens, "the next frame has the new count");
    }
    idle("an idle tab");
    // A tab that goes away in the middle.
    tab.send_view(1);
    drop(tab);
    std::thread::sleep(Duration::from_secs(1));
    idle("a closed tab");
}
