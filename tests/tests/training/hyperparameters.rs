//! Effects of hyper-parameters on the weights.

use crate::support::{Place, Weights};

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
