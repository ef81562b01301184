use super::*;

const HEAD: &str =
    "scene,target_frame,method,num_storage_tokens,num_render_tokens,psnr,ssim,lpips_vgg,render_s,select_s,tokens";

fn evaluation(folder: &Path, name: &str, rows: &[&str]) -> Evaluation {
    let path = folder.join(name);
    std::fs::create_dir_all(path.join("eval")).unwrap();
    let text = format!("{HEAD}\n{}\n", rows.join("\n"));
    std::fs::write(path.join("eval/views.csv"), text).unwrap();
    Evaluation::read(&path).unwrap()
}

#[test]
fn differences_are_paired_by_view() {
    let folder = tempfile::tempdir().unwrap();
    let a = evaluation(
        folder.path(),
        "a",
        &[
            "x,1,clift,8,8,20,0.5,,0.1,,f32",
            "x,2,clift,8,8,22,0.5,,0.1,,f32",
            "y,1,clift,8,8,30,0.5,,0.1,,f32",
            "z,1,clift,8,8,10,0.5,,0.1,,f32",
        ],
    );
    // Another order, one additional view and one missing view.
    let b = evaluation(
        folder.path(),
        "b",
        &[
            "y,1,clift,8,8,33,0.6,0.1,0.1,,f32",
            "x,2,clift,8,8,23,0.5,,0.1,,f32",
            "x,1,clift,8,8,21,0.5,,0.1,,f32",
            "w,1,clift,8,8,10,0.5,,0.1,,f32",
        ],
    );
    let comparison = Comparison::new(&a, &b, None).unwrap();
    let [pair] = &comparison.pairs[..] else { panic!("{comparison:?}") };
    assert_eq!((pair.num_scenes, pair.num_views, pair.num_only_a, pair.num_only_b), (2, 3, 1, 1));
    let psnr = pair.psnr.unwrap();
    // Scene means 21 -> 22 and 30 -> 33: differences 1 and 3, standard error 1, t of one degree of freedom.
    assert_eq!((psnr.a, psnr.b, psnr.mean, psnr.stderr), (25.5, 27.5, 2.0, Some(1.0)));
    let [low, high] = psnr.interval.unwrap();
    assert!((low - (2.0 - 12.706_204_736)).abs() < 1e-6 && (high - (2.0 + 12.706_204_736)).abs() < 1e-6);
    assert!(!psnr.is_clear());
    assert_eq!(pair.lpips_vgg, None, "only one evaluation has LPIPS");
    let text = comparison.to_string();
    assert!(text.contains("clift 8 f32") && text.contains("+2.000 [-10.706, +14.706]"), "{text}");
    assert!(text.contains("up to 1 views of A and 1 views of B are ignored"), "{text}");
}

#[test]
fn sharpness_is_compared_where_both_have_it() {
    let folder = tempfile::tempdir().unwrap();
    let sharp = |name: &str, values: [f64; 2]| {
        let path = folder.path().join(name);
        let rows = format!("x,1,clift,8,8,20,,,,,f32,{}\ny,1,clift,8,8,20,,,,,f32,{}\n", values[0], values[1]);
        std::fs::write(&path, format!("{HEAD},sharpness\n{rows}")).unwrap();
        Evaluation::read(&path).unwrap()
    };
    let (a, b) = (sharp("a", [0.25, 0.5]), sharp("b", [0.5, 0.75]));
    let comparison = Comparison::new(&a, &b, None).unwrap();
    assert_eq!(comparison.pairs[0].sharpness.unwrap().mean, 0.25);
    assert!(comparison.to_string().contains("+0.250 [+0.250, +0.250] *"), "{comparison}");
    // A file without the column.
    let older = evaluation(folder.path(), "older", &["x,1,clift,8,8,20,,,,,f32"]);
    assert_eq!(Comparison::new(&a, &older, None).unwrap().pairs[0].sharpness, None);
}

#[test]
fn keys_of_one_side_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let a = evaluation(folder.path(), "a", &["x,1,clift,8,8,20,,,,,f32", "x,1,tile,8,8,19,,,,,f32"]);
    let b = evaluation(folder.path(), "b", &["x,1,clift,8,8,20,,,,,f16", "x,1,tile,8,8,19,,,,,f32"]);
    let comparison = Comparison::new(&a, &b, None).unwrap();
    assert_eq!(comparison.pairs.len(), 1);
    let text = comparison.to_string();
    assert!(text.contains("Only in A, not compared: clift 8 f32.\nOnly in B, not compared: clift 8 f16.\n"), "{text}");
    let sides = ["clift:f32", "clift:f16"].map(|side| MethodFilter::parse(side).unwrap());
    let comparison = Comparison::new(&a, &b, Some(&sides)).unwrap();
    assert!(comparison.only_a.is_empty() && comparison.only_b.is_empty());
}

#[test]
fn methods_are_compared_at_equal_counts() {
    let folder = tempfile::tempdir().unwrap();
    let rows = [
        "x,1,kmeans,8,8,20,,,,,f32",
        "x,1,kmeans,8,8,19,,,,,int8",
        "x,1,kmeans,16,16,25,,,,,f32",
        "x,1,clift,8,8,21,,,,,f32",
        "x,1,clift,16,8,90,,,,,f32",
        "x,1,clift,16,16,inf,,,,,f32",
    ];
    let all = evaluation(folder.path(), "all", &rows);
    let sides = [MethodFilter::parse("kmeans:f32").unwrap(), MethodFilter::parse("clift").unwrap()];
    let comparison = Comparison::new(&all, &all, Some(&sides)).unwrap();
    let means: Vec<f64> = comparison.pairs.iter().map(|pair| pair.psnr.unwrap().mean).collect();
    // An identical image counts as 100 dB.
    assert_eq!(means, [1.0, 75.0]);
    assert!(comparison.to_string().contains("kmeans 8 f32 -> clift 8 f32"), "{comparison}");
    let sides = [MethodFilter::parse("kmeans:f32").unwrap(), MethodFilter::parse("kmeans:int8").unwrap()];
    assert_eq!(Comparison::new(&all, &all, Some(&sides)).unwrap().pairs.len(), 1);
}

#[test]
fn incomparable_evaluations_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let a = evaluation(folder.path(), "a", &["x,1,clift,8,8,20,,,,,f32"]);
    let counts = evaluation(folder.path(), "counts", &["x,1,clift,16,16,20,,,,,f32"]);
    let scenes = evaluation(folder.path(), "scenes", &["y,1,clift,8,8,20,,,,,f32"]);
    let message = |b: &Evaluation| Comparison::new(&a, b, None).unwrap_err().to_string();
    assert!(message(&counts).contains("no common method and token count") && message(&counts).contains("clift 16 f32"));
    assert!(message(&scenes).contains("no common target view") && message(&scenes).contains("y, frame 1"));
    let missing = Evaluation::read(&folder.path().join("nowhere")).unwrap_err().to_string();
    assert!(missing.contains("`clift eval` writes the file") && missing.ends_with("nowhere"), "{missing}");
    let bad = folder.path().join("views.csv");
    std::fs::write(&bad, format!("{HEAD}\nx,1,clift,eight,8,20,,,,,f32\n")).unwrap();
    assert!(Evaluation::read(&bad).is_err());
}
