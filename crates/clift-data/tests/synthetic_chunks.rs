//! Synthetic scenes written as chunks and read back.

use std::path::Path;

use clift_data::{
    Camera, ChunkSource, ImageEncoding, SceneFilters, SceneSource, Split, SyntheticConfig, SyntheticSource,
    write_source,
};

fn synthetic(split: Split) -> SyntheticSource {
    let config =
        SyntheticConfig { seed: 5, split, num_scenes: 5, num_frames: 6, width: 40, height: 24, ..Default::default() };
    SyntheticSource::new(config).unwrap()
}

/// Writes both splits, about two scenes to a chunk.
fn write(root: &Path) {
    for split in [Split::Train, Split::Test] {
        let folder = root.join(split.to_string());
        let written = write_source(&synthetic(split), &folder, ImageEncoding::Png, 25_000, |_| ()).unwrap();
        assert_eq!((written.num_scenes, written.num_frames), (5, 30));
    }
}

fn numbers(camera: &Camera) -> Vec<f64> {
    let k = camera.intrinsics_norm;
    [k.fx, k.fy, k.cx, k.cy].into_iter().chain(camera.c2w.to_matrix_f64()).collect()
}

#[test]
fn frames_round_trip_and_cameras_to_f32() {
    let root = tempfile::tempdir().unwrap();
    write(root.path());
    for split in [Split::Train, Split::Test] {
        let chunks = ChunkSource::open(root.path(), split, &SceneFilters::default()).unwrap();
        let source = synthetic(split);
        assert_eq!(chunks.num_scenes(), 5);
        for scene in 0..5 {
            let stored = chunks.find(source.key(scene)).unwrap();
            assert_eq!(chunks.timestamps(stored).unwrap(), [0, 1, 2, 3, 4, 5]);
            for frame in 0..6 {
                assert_eq!(chunks.frame(stored, frame).unwrap(), source.frame(scene, frame).unwrap());
            }
            let (got, expected) = (chunks.cameras(stored).unwrap(), source.cameras(scene).unwrap());
            assert_eq!(got.len(), expected.len());
            for (got, expected) in got.iter().zip(&expected) {
                for (got, expected) in numbers(got).into_iter().zip(numbers(expected)) {
                    // Rooms are up to 4 wide: a stored w2c has an error of 2^-23, its inverse a few times that.
                    assert!((got - expected).abs() < 2e-6, "{got} against {expected}");
                }
            }
        }
    }
}
