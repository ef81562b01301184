//! The page in headless Chromium.

use std::process::Command;
use std::time::{Duration, Instant};

use base64::prelude::{BASE64_STANDARD, Engine};

use crate::support::{BINARY, Place, WHOLE, finish, skip, start};
use crate::viewer::chromium::Chromium;
use crate::viewer::tab::Viewer;

/// Waits until the page shows a picture at rest of a later camera than `seq`; returns its number.
fn rest_after(browser: &mut Chromium, seq: u64) -> u64 {
    let shown = "(document.documentElement.dataset.picture ?? 'none 0 0').split(' ')";
    browser.wait_for(&format!("((p) => p[0] === 'rest' && Number(p[1]) > {seq})({shown})"));
    browser.evaluate(&format!("Number({shown}[1])")).as_u64().expect("a number")
}

/// The pixels on the screen.
fn pixels(browser: &mut Chromium) -> image::RgbImage {
    let url = browser.evaluate("document.getElementById('picture').toDataURL('image/png')");
    let (_, data) = url.as_str().expect("text").split_once(',').expect("a data URL");
    image::load_from_memory(&BASE64_STANDARD.decode(data).expect("base64")).expect("PNG").to_rgb8()
}

#[test]
fn browser_turns_the_camera_and_renders_its_exported_path() {
    let place = Place::with(&WHOLE);
    let Some(mut browser) = Chromium::start(&place.at("")) else {
        return skip("chromium", "no Chromium on the PATH");
    };
    let viewer = Viewer::start(&["run"], &place.at(""));
    browser.open(&viewer.url);
    let seq = rest_after(&mut browser, 0);
    assert_eq!(browser.evaluate("location.search"), "", "the token is not left in the address");
    let first = pixels(&mut browser);

    browser.drag([400.0, 400.0], [520.0, 430.0]);
    let seq = rest_after(&mut browser, seq);
    let turned = pixels(&mut browser);
    assert_ne!(first, turned, "another camera");

    browser.evaluate(
        "const render = document.getElementById('render'); render.value = 0; render.dispatchEvent(new Event('input'))",
    );
    let seq = rest_after(&mut browser, seq);
    assert!(
        browser.evaluate("document.getElementById('used').textContent").as_str().expect("text").starts_with("1 of ")
    );
    let few = pixels(&mut browser);
    assert_ne!(turned, few, "another number of tokens");

    // The true image, its PSNR, and the marks on the context views.
    browser.wait_for("document.getElementById('psnr').textContent.endsWith(' dB')");
    browser.evaluate("document.getElementById('compare').click()");
    browser.wait_for("!document.getElementById('wipe').hidden");
    let seq = rest_after(&mut browser, seq);
    browser.evaluate("document.querySelector('#overlay [data-value=clusters]').click()");
    let seq = rest_after(&mut browser, seq);

    // The picture on the screen equals that of the exported camera, with one selected token.
    browser.evaluate("document.querySelector('#selection [data-value=global]').click()");
    let seq = rest_after(&mut browser, seq);
    let shown = pixels(&mut browser);
    assert_same(&render_export(&mut browser, &place, 1), &shown);

    // The end of a path of two keyframes, with all tokens. The wipe would take the mouse.
    browser.evaluate("document.getElementById('compare').click()");
    browser.evaluate("render.value = render.max; render.dispatchEvent(new Event('input'))");
    let seq = rest_after(&mut browser, seq);
    browser.evaluate("document.getElementById('add-keyframe').click()");
    browser.drag([400.0, 400.0], [330.0, 380.0]);
    rest_after(&mut browser, seq);
    browser.evaluate("document.getElementById('add-keyframe').click()");
    let shown = pixels(&mut browser);
    browser.evaluate("const seconds = document.getElementById('seconds'); seconds.value = 1; seconds.dispatchEvent(new Event('input'))");
    assert_same(&render_export(&mut browser, &place, 20), &shown);

    browser.evaluate("document.getElementById('play').click()");
    browser.wait_for("document.documentElement.dataset.picture.startsWith('moving')");
    browser.wait_for("document.documentElement.dataset.picture.startsWith('rest')");
    assert_same(&pixels(&mut browser), &shown);
    assert_eq!(browser.problems, [""; 0], "errors of the page");
}

#[track_caller]
fn assert_same(rendered: &image::RgbImage, shown: &image::RgbImage) {
    assert_eq!(rendered.dimensions(), shown.dimensions());
    let most = rendered.as_raw().iter().zip(shown.as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
    // The pose goes to the world of the capture and back.
    assert!(most <= Some(1), "{most:?} grey levels");
}

/// Exports the path, runs the commands of the page on the file, and returns the last of `num_frames` frames.
fn render_export(browser: &mut Chromium, place: &Place, num_frames: usize) -> image::RgbImage {
    drop(std::fs::remove_file(place.at("poses.json")));
    browser.evaluate("document.getElementById('export').click()");
    let started = Instant::now();
    while !place.at("poses.json").exists() {
        assert!(started.elapsed() < Duration::from_mins(1), "no download");
        std::thread::sleep(Duration::from_millis(20));
    }
    let commands = browser.evaluate("document.getElementById('command').textContent");
    let commands: Vec<&str> = commands.as_str().expect("text").lines().collect();
    assert_eq!(commands.len(), 2, "encode and render: {commands:?}");
    for command in commands {
        let mut words = shlex::split(command).expect("a shell command");
        assert_eq!(words.remove(0), "clift");
        words.push("--force".into());
        finish(start(Command::new(BINARY).args(&words).current_dir(place.at("")))).ok();
    }
    let frames = place.names("frames").iter().filter(|name| name.starts_with("frame-")).count();
    assert_eq!(frames, num_frames);
    image::open(place.at(&format!("frames/frame-{:05}.png", num_frames - 1))).expect("PNG").to_rgb8()
}
