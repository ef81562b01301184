//! Effects of hyper-parameters on the weights.

use crate::support::{Place, WHOLE, Weights};

/// Root mean square change of all values.
fn rms_move(after: &Weights, before: &Weights) -> f64 {
    let count = before.0.values().map(Vec::len).sum::<usize>() as f64;
    (after.moved_from(before).map(|moved| moved * moved).sum::<f64>() / count).sqrt()
}

#[test]
fn stage_2_freezes_the_encoder_and_trains_the_rest() {
    let place = Place::new();
    // Two clusters of eight tokens: with a single key there is nothing for a query to choose.
    let grid = "clusters.grid=[0.25]";
    place.train("run", &["stage2.steps=8", "stage2.optimizer.weight_decay=0.05", grid]).ok();
    let (before, after) = (place.weights("run", "stage1"), place.weights("run", "stage2"));
    assert_eq!(after.part("encoder."), before.part("encoder."), "bit for bit, in spite of the weight decay");
    for (name, values) in &after.part("renderer.").0 {
        assert_ne!(*values, before.0[name], "{name} does not move");
    }
    // Where the condenser starts: stage 2 with a rate too small for f32 to show.
    place.train("still", &["stage2.steps=1", "stage2.optimizer.learning_rate=1e-30", grid]).ok();
    let still = place.weights("still", "stage2");
    assert_eq!(still.part("renderer."), before.part("renderer."));
    for (name, values) in &after.part("condenser.").0 {
        assert_ne!(*values, still.0[name], "{name} does not move");
    }
}

#[test]
fn stage_2_saves_weights_between_its_start_and_its_end() {
    let place = Place::new();
    let between = "stage2.weight_interpolation=0.25";
    let assert_between = |run: &str, start: &Weights, end: &Weights| {
        let found = place.weights(run, "stage2");
        assert_eq!(found.0.len(), end.0.len());
        for (name, values) in &found.0 {
            for (i, &value) in values.iter().enumerate() {
                // Of a condenser that starts untrained, only the gates: they start at zero.
                let [start, end] = [start, end].map(|weights| weights.0.get(name).map(|values| values[i]));
                let end = end.expect("the same parameters");
                let start = start.unwrap_or(if name.contains(".gate.") { 0.0 } else { end });
                let expected = start + 0.25 * (end - start);
                // A few roundings in f32, of 6e-8 each.
                assert!((value - expected).abs() <= 1e-6 * expected.abs().max(1e-3), "{name}: {value}, not {expected}");
            }
        }
    };
    place.copy(&WHOLE, "whole");
    place.train("new", &[between]).ok().notes("saving the weights at 0.25 of the way from its start");
    let [stage1, whole] = ["stage1", "stage2"].map(|stage| place.weights("whole", stage));
    assert_between("new", &stage1, &whole);
    assert_eq!(place.weights("new", "stage2").part("encoder."), stage1.part("encoder."), "bit for bit");

    // Made again from the last checkpoint, by a process killed before it wrote them.
    let file = "new/stage2/model.safetensors";
    let bytes = place.bytes(file);
    std::fs::remove_file(place.at(file)).expect("removed");
    place.train("new", &[between]).ok();
    assert!(place.bytes(file) == bytes);

    // A condenser that was trained before starts where it was.
    let from = format!("stage2.init_from={:?}", place.at("whole").display().to_string());
    place.train("later", &[&from]).ok();
    place.train("trained", &[&from, between]).ok();
    let start = Weights(stage1.0.into_iter().chain(whole.part("condenser.").0).collect());
    assert_between("trained", &start, &place.weights("later", "stage2"));
    for bad in ["0.0", "1.5", "nan"] {
        let set = format!("stage2.weight_interpolation={bad}");
        place.train("bad", &[&set]).fails_with(2, &["stage2.weight_interpolation", "above 0, at most 1"]);
    }
}

#[test]
fn the_renderer_learns_at_its_own_rate() {
    let place = Place::new();
    // One step at the full rate without decay: Adam moves each value by the rate, whatever its gradient.
    let one_step = ["stage2.steps=1", "stage2.optimizer.warm_up_steps=1", "stage2.optimizer.weight_decay=0.0"];
    let moved = |name: &str, factor: &str| {
        let factor = format!("stage2.renderer_lr_factor={factor}");
        let set = [&one_step[..], &[factor.as_str()]].concat();
        place.train(name, &set).ok();
        let (before, after) = (place.weights(name, "stage1"), place.weights(name, "stage2"));
        rms_move(&after.part("renderer."), &before.part("renderer."))
    };
    let (full, tenth, none) = (moved("full", "1.0"), moved("tenth", "0.1"), moved("none", "0.0"));
    // Values with a gradient near Adam's epsilon of 1e-8 move less than the rate of 1e-3.
    assert!((0.5e-3..=1.001e-3).contains(&full), "{full}");
    // Weights of 0.1 to 1 hold a move of 1e-4 to within 6e-8 / 1e-4 = 6e-4 each.
    assert!((tenth / full - 0.1).abs() < 1e-4, "{}", tenth / full);
    assert_eq!(none, 0.0);
}

#[test]
fn weight_decay_and_learning_rate_reach_the_weights() {
    let place = Place::new();
    let train = |name: &str, set: &[&str]| {
        let set = [&["stage1.steps=1", "stage1.optimizer.warm_up_steps=1"], set].concat();
        place.train(&format!("{name} --only stage1"), &set).ok();
        place.weights(name, "stage1")
    };
    let start = train("start", &["stage1.optimizer.learning_rate=1e-30"]);
    let plain = train("plain", &["stage1.optimizer.weight_decay=0.0"]);
    let double = train("double", &["stage1.optimizer.weight_decay=0.0", "stage1.optimizer.learning_rate=2e-3"]);
    // As above: the ratio is exact but for the rounding of the weights.
    assert!((rms_move(&double, &start) / rms_move(&plain, &start) - 2.0).abs() < 1e-3);
    let decayed = train("decayed", &["stage1.optimizer.weight_decay=10.0"]);
    for ((name, decayed), start) in decayed.0.iter().zip(start.0.values()) {
        for ((decayed, plain), start) in decayed.iter().zip(&plain.0[name]).zip(start) {
            // Decoupled: the rate times the decay times the weight before, 1e-2 of it; rounding of weights below 2.
            let expected = f64::from(*plain) - 1e-2 * f64::from(*start);
            assert!((f64::from(*decayed) - expected).abs() < 3e-7, "{name}: {decayed} is not {expected}");
        }
    }
}
