//! What stage 2 trains and saves.

use crate::support::{Place, WHOLE, Weights};

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
