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
    let comparison = Comparison::new(&a, &b).unwrap();
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
fn keys_of_one_side_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let a = evaluation(folder.path(), "a", &["x,1,clift,8,8,20,,,,,f32", "x,1,tile,8,8,19,,,,,f32"]);
    let b = evaluation(folder.path(), "b", &["x,1,clift,8,8,20,,,,,f16", "x,1,tile,8,8,19,,,,,f32"]);
    let comparison = Comparison::new(&a, &b).unwrap();
    assert_eq!(comparison.pairs.len(), 1);
    let text = comparison.to_string();
    assert!(text.contains("Only in A, not compared: clift 8 f32.\nOnly in B, not compared: clift 8 f16.\n"), "{text}");
}

#[test]
fn incomparable_evaluations_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let a = evaluation(folder.path(), "a", &["x,1,clift,8,8,20,,,,,f32"]);
    let counts = evaluation(folder.path(), "counts", &["x,1,clift,16,16,20,,,,,f32"]);
    let scenes = evaluation(folder.path(), "scenes", &["y,1,clift,8,8,20,,,,,f32"]);
    let message = |b: &Evaluation| Comparison::new(&a, b).unwrap_err().to_string();
    assert!(message(&counts).contains("no common method and token count") && message(&counts).contains("clift 16 f32"));
    assert!(message(&scenes).contains("no common target view") && message(&scenes).contains("y, frame 1"));
    let missing = Evaluation::read(&folder.path().join("nowhere")).unwrap_err().to_string();
    assert!(missing.contains("`clift eval` writes the file") && missing.ends_with("nowhere"), "{missing}");
    let bad = folder.path().join("views.csv");
    std::fs::write(&bad, format!("{HEAD}\nx,1,clift,eight,8,20,,,,,f32\n")).unwrap();
    assert!(Evaluation::read(&bad).is_err());
}
