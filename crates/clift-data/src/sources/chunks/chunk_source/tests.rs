use super::*;
use crate::sources::chunks::writer::{SceneRecord, chunk_bytes, scene_file_bytes, write_chunks};
use crate::testing::{fixture, re10k_mini};
use crate::torch::pickle_writer::PickleWriter;
use safetensors::SafeTensors;

const ALL: SceneFilters = SceneFilters { min_frames: 0, max_fov_deg: None };

fn with_chunk(bytes: &[u8], keys: &[&str]) -> (tempfile::TempDir, ChunkSource) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("train")).unwrap();
    std::fs::write(folder.path().join("train/000000.torch"), bytes).unwrap();
    let index: BTreeMap<_, _> = keys.iter().map(|key| (*key, "000000.torch")).collect();
    std::fs::write(folder.path().join("train/index.json"), serde_json::to_vec(&index).unwrap()).unwrap();
    let source = ChunkSource::open(folder.path(), Split::Train, &ALL).unwrap();
    (folder, source)
}

fn mini_chunk() -> Vec<u8> {
    std::fs::read(fixture("re10k-mini/train/000000.torch")).unwrap()
}

#[test]
fn chunks_of_torch_save_are_read_by_frame() {
    let source = re10k_mini(Split::Train);
    assert_eq!(source.num_scenes(), 2);
    assert_eq!(source.report.to_string(), "2 of 2 scenes used");
    let scene = source.find("00000000000000a2").unwrap();
    assert_eq!(source.key(scene), "00000000000000a2");
    assert_eq!(source.url(scene).unwrap(), "https://example.org/00000000000000a2");
    assert_eq!(source.timestamps(scene).unwrap(), [0, 1, 2, 3, 4, 5, 6, 7].map(|frame| 1_000_000 + 33_367 * frame));
    let bytes = std::fs::read(fixture("reference/re10k_mini.safetensors")).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let frame = source.frame(scene, 3).unwrap();
    let expected = tensors.tensor("frame").unwrap();
    assert_eq!(expected.shape(), [frame.height, frame.width, 3]);
    let worst = frame.rgb.iter().zip(expected.data()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(worst <= Some(4), "{worst:?}"); // JPEG decoders round differently, chroma most
    let expected: Vec<f64> =
        tensors.tensor("c2w").unwrap().data().as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
    let c2w = source.cameras(scene).unwrap()[3].c2w.to_matrix();
    for (got, expected) in c2w.iter().zip(&expected) {
        assert!((f64::from(*got) - expected).abs() < 1e-6, "{got} against {expected}"); // f32 file, f32 matrix
    }
}

#[test]
fn scene_without_frames_is_no_scene() {
    let (key, url) = ("a".to_owned(), String::new());
    let empty = SceneRecord { key, url, timestamps: Vec::new(), cameras: Vec::new(), images: Vec::new() };
    let (folder, source) = with_chunk(&scene_file_bytes("a".as_ref(), &empty).unwrap(), &["a"]);
    for error in [source.cameras(0).err(), source.num_frames(0).err()] {
        assert!(error.unwrap().to_string().contains("scene a has no frames"));
    }
    let filters = SceneFilters { min_frames: 1, ..ALL };
    let filtered = ChunkSource::open(folder.path(), Split::Train, &filters).unwrap();
    assert_eq!((filtered.num_scenes(), filtered.report.skips.len()), (0, 1));
    assert!(filtered.report.skips[0].reason.contains("has no frames"));
}

#[test]
fn filters_skip_scenes_with_reasons() {
    let open = |min_frames, max_fov_deg| {
        let filters = SceneFilters { min_frames, max_fov_deg };
        ChunkSource::open(&fixture("re10k-mini"), Split::Train, &filters).unwrap()
    };
    assert_eq!(open(8, Some(60.0)).num_scenes(), 2);
    let short = open(9, None);
    assert_eq!((short.num_scenes(), short.find("00000000000000a1")), (0, None));
    assert_eq!(short.report.to_string(), "0 of 2 scenes used; 2 shorter than the 9 frames of data.filters.min_frames");
    // fx = 0.9 of the width: 58.1 degrees.
    assert_eq!(open(8, Some(58.0)).report.to_string(), "0 of 2 scenes used; 2 with a field of view above 58 degrees");
}

#[test]
fn bad_chunks_are_named_with_the_problem() {
    let mini = mini_chunk();
    let truncated = |length: usize| mini[..length].to_vec();
    for (bytes, key, expected) in [
        (truncated(10), "a", "truncated"),
        (truncated(mini.len() / 2), "a", "truncated"),
        (truncated(mini.len() - 10), "a", "truncated"),
        (std::fs::read(fixture("hostile/calls_system.torch")).unwrap(), "a", "`os.system`"),
        (mini.clone(), "00ff", "expected scene 00ff, found 2 other scenes"),
    ] {
        let (_folder, source) = with_chunk(&bytes, &[key]);
        for error in [source.frame(0, 0).err(), source.cameras(0).err()] {
            let message = error.unwrap().to_string();
            assert!(message.contains(expected) && message.ends_with("000000.torch"), "{expected}: {message}");
        }
    }
}

#[test]
fn flipped_bits_are_found_by_checksum() {
    let mut bytes = mini_chunk();
    let start = bytes.windows(4).position(|window| window == b"\xff\xd8\xff\xe0").unwrap();
    bytes[start + 700] ^= 1;
    let (_folder, source) = with_chunk(&bytes, &["00000000000000a1"]);
    let message = source.frame(0, 0).unwrap_err().to_string();
    assert!(message.contains("has another checksum") && message.ends_with("000000.torch"), "{message}");
    assert!(source.frame(0, 1).is_ok());
}

#[test]
fn errors_of_bad_indices_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let open = || ChunkSource::open(folder.path(), Split::Test, &ALL).err().map(|error| error.to_string()).unwrap();
    assert!(open().starts_with("reading the scene index failed: "), "{}", open());
    std::fs::create_dir(folder.path().join("test")).unwrap();
    let index = folder.path().join("test/index.json");
    std::fs::write(&index, "[1, 2]").unwrap();
    assert!(open().contains("expected a map from scene keys to chunk files"), "{}", open());
    std::fs::write(&index, r#"{"a": "../../secret.torch"}"#).unwrap();
    assert!(open().contains("expected a file beside the index"), "{}", open());
    std::fs::write(&index, r#"{"a": ""}"#).unwrap();
    assert!(open().contains(r#"scene a is in "", expected a file beside the index"#), "{}", open());
    std::fs::write(&index, r#"{"a": "000000.torch"}"#).unwrap();
    assert!(open().starts_with("opening a chunk that index.json lists failed"), "{}", open());
    assert!(open().ends_with("000000.torch"), "{}", open());
    std::fs::create_dir(folder.path().join("test/000000.torch")).unwrap();
    let expected = "bad chunk: a folder, which index.json lists as a chunk: ";
    assert!(open().starts_with(expected) && open().ends_with("000000.torch"), "{}", open());
}

/// A data set of the mini chunk under three names, the last of which is changed, with a scene of each.
fn three_chunks(change: impl FnOnce(&Path)) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let train = folder.path().join("train");
    std::fs::create_dir(&train).unwrap();
    for name in ["0.torch", "1.torch", "2.torch"] {
        std::fs::write(train.join(name), mini_chunk()).unwrap();
    }
    let index = r#"{"00000000000000a1": "0.torch", "00000000000000a2": "2.torch"}"#;
    std::fs::write(train.join("index.json"), index).unwrap();
    change(&train.join("2.torch"));
    folder
}

#[test]
fn scenes_of_failing_chunks_are_skipped_with_the_error() {
    let lists = SceneFilters { min_frames: 8, max_fov_deg: None };
    let truncate = |path: &Path| std::fs::write(path, &mini_chunk()[..3000]).unwrap();
    let remove = |path: &Path| std::fs::remove_file(path).unwrap();
    for (folder, filters, reason) in [
        (three_chunks(truncate), &lists, "1 bad chunk: "),
        (three_chunks(remove), &lists, "1 opening a chunk that index.json lists failed: "),
        (three_chunks(remove), &ALL, "1 opening a chunk that index.json lists failed: "),
    ] {
        let source = ChunkSource::open(folder.path(), Split::Train, filters).unwrap();
        assert_eq!((source.num_scenes(), source.key(0)), (1, "00000000000000a1"));
        assert!(source.find("00000000000000a2").is_none() && source.frame(0, 0).is_ok());
        let report = source.report.to_string();
        assert!(report.starts_with(&format!("1 of 2 scenes used; {reason}")), "{report}");
        assert!(report.contains("2.torch"), "{report}");
    }
}

#[test]
fn frames_whose_cameras_cannot_be_used_are_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let source = re10k_mini(Split::Train);
    let records = (0..2).map(|scene| {
        let mut cameras = source.cameras(scene).unwrap();
        if scene == 0 {
            cameras[3].c2w.translation[1] = f64::NAN;
        }
        let images = (0..8).map(|frame| source.encoded_frame(scene, frame).unwrap().unwrap()).collect();
        let (key, timestamps) = (source.key(scene).into(), source.timestamps(scene).unwrap());
        Ok(SceneRecord { key, url: String::new(), timestamps, cameras, images })
    });
    write_chunks(&folder.path().join("train"), records, u64::MAX).unwrap();
    let whole = source;
    for (min_frames, max_fov_deg) in [(0, None), (1, None), (1, Some(100.0))] {
        let filters = SceneFilters { min_frames, max_fov_deg };
        let source = ChunkSource::open(folder.path(), Split::Train, &filters).unwrap();
        let scene = source.find("00000000000000a1").unwrap();
        assert_eq!((source.num_scenes(), source.num_frames(scene).unwrap()), (2, 7));
        let [skip] = &source.report.frames[..] else { panic!("{}", source.report) };
        assert!(skip.frame == "3" && skip.reason.starts_with("whose camera cannot be used: bad camera: "), "{skip:?}");
        let kept = [0, 1, 2, 4, 5, 6, 7];
        assert_eq!(source.timestamps(scene).unwrap(), kept.map(|frame| whole.timestamps(0).unwrap()[frame]));
        assert_eq!(source.cameras(scene).unwrap()[3], whole.cameras(0).unwrap()[4]);
        assert_eq!(source.frame(scene, 3).unwrap(), whole.frame(0, 4).unwrap());
    }
}

#[test]
fn scaled_rotations_and_far_cameras_are_noted() {
    let (folder, whole) = (tempfile::tempdir().unwrap(), re10k_mini(Split::Train));
    let records = (0..2).map(|scene| {
        let mut cameras = whole.cameras(scene).unwrap();
        if scene == 0 {
            for camera in &mut cameras {
                camera.c2w.rotation *= 4.0;
                camera.c2w.translation *= 4.0; // its inverse has the translation as it was
            }
        } else {
            cameras[5].c2w.translation[1] = 1e5;
        }
        let images = (0..8).map(|frame| whole.encoded_frame(scene, frame).unwrap().unwrap()).collect();
        let (key, timestamps) = (whole.key(scene).into(), whole.timestamps(scene).unwrap());
        Ok(SceneRecord { key, url: String::new(), timestamps, cameras, images })
    });
    write_chunks(&folder.path().join("train"), records, u64::MAX).unwrap();
    let source = ChunkSource::open(folder.path(), Split::Train, &ALL).unwrap();
    let notes = [
        "1 scene with scaled rotations, whose scale was divided out (00000000000000a1)",
        "1 scene with cameras far from the others, which set the scale if they are contexts (00000000000000a2)",
    ];
    assert_eq!(source.report.notes, notes);
    for (got, expected) in source.cameras(0).unwrap().iter().zip(whole.cameras(0).unwrap()) {
        assert!(got.c2w.angle_to(expected.c2w) < 1e-5, "{got:?} {expected:?}"); // f32
        assert!(got.c2w.translation.distance(expected.c2w.translation) < 1e-5, "{got:?} {expected:?}");
    }
}

/// A chunk of one scene of two frames, whose time stamps and further entry are raw opcodes.
fn odd_chunk(timestamps: &[u8], extra: &[u8]) -> Vec<u8> {
    let source = re10k_mini(Split::Train);
    let mut pickle = PickleWriter::new();
    pickle.raw(b"](}(");
    pickle.string("key");
    pickle.string("a");
    pickle.raw(extra);
    pickle.raw(timestamps);
    pickle.string("cameras");
    let rows: Vec<u8> = source.cameras(0).unwrap()[..2]
        .iter()
        .flat_map(|camera| camera.to_re10k().map(|value| (value as f32).to_le_bytes()))
        .flatten()
        .collect();
    pickle.tensor("FloatStorage", rows, &[2, 18]);
    pickle.string("images");
    pickle.raw(b"](");
    for frame in 0..2 {
        let image = source.encoded_frame(0, frame).unwrap().unwrap();
        let length = image.len();
        pickle.tensor("ByteStorage", image, &[length]);
    }
    pickle.raw(b"eue.");
    pickle.pack("odd").unwrap()
}

#[test]
fn unused_entries_of_any_kind_are_skipped_and_time_stamps_may_be_missing() {
    let tensor = |storage_type: &str, bytes: usize| {
        let mut writer = PickleWriter::new();
        writer.tensor(storage_type, vec![0; bytes], &[2]);
        writer.pickle()[2..].to_vec()
    };
    let entry =
        |name: &str, value: &[u8]| [b"X", &(name.len() as u32).to_le_bytes()[..], name.as_bytes(), value].concat();
    let numpy = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\0\x85c_codecs\nencode\nX\x01\0\0\0bX\x06\0\0\0latin1\x86R\x87R\
        (K\x01K\x02\x85cnumpy\ndtype\nX\x02\0\0\0f4\x89\x88\x87R(K\x03X\x01\0\0\0<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\0tb\x89C\x02xytb";
    let plain = entry("timestamps", &tensor("LongStorage", 16));
    for (what, timestamps, extra, has_times) in [
        ("int64", plain.clone(), Vec::new(), true),
        ("int32", entry("timestamps", &tensor("IntStorage", 8)), Vec::new(), false),
        ("float", entry("timestamps", &tensor("FloatStorage", 8)), Vec::new(), false),
        ("half", entry("timestamps", &tensor("HalfStorage", 4)), Vec::new(), false),
        ("list", entry("timestamps", b"](K\x01K\x02e"), Vec::new(), false),
        ("absent", Vec::new(), Vec::new(), false),
        ("numpy array", plain.clone(), entry("depth", numpy), true),
        ("bool tensor", plain.clone(), entry("mask", &tensor("BoolStorage", 2)), true),
        ("bf16 tensor", plain.clone(), entry("x", &tensor("BFloat16Storage", 4)), true),
        ("torch.Size", plain.clone(), entry("size", b"ctorch\nSize\n(K\x04K\x05t\x85R"), true),
        ("bytes", plain.clone(), entry("raw", b"C\x03abc"), true),
        ("set", plain.clone(), entry("set", b"\x8f(K\x01K\x02\x90"), true),
        ("Path", plain.clone(), entry("path", b"cpathlib\nPosixPath\nX\x01\0\0\0a\x85R"), true),
    ] {
        let (folder, _) = with_chunk(&odd_chunk(&timestamps, &extra), &["a"]);
        let filters = SceneFilters { min_frames: 2, ..ALL };
        let source =
            ChunkSource::open(folder.path(), Split::Train, &filters).unwrap_or_else(|error| panic!("{what}: {error}"));
        assert_eq!(source.timestamps(0).unwrap() != [0, 1], has_times, "{what}");
        assert!(source.frame(0, 1).is_ok() && source.cameras(0).is_ok(), "{what}");
        let note = "1 scene without time stamps as int64, which are counted 0, 1, .. (a)";
        assert_eq!(source.report.notes.iter().any(|got| got == note), !has_times, "{what}: {}", source.report);
    }
    for (module, name) in [("os", "system"), ("builtins", "eval"), ("subprocess", "Popen")] {
        let call = [format!("c{module}\n{name}\n").as_bytes(), b"X\x02\0\0\0ls\x85R"].concat();
        let (_folder, source) = with_chunk(&odd_chunk(&plain, &entry("x", &call)), &["a"]);
        let message = source.num_frames(0).unwrap_err().to_string();
        assert!(message.contains(&format!("`{module}.{name}`")) && message.contains("no code was run"), "{message}");
    }
}

#[test]
fn chunks_without_checksums_are_read_with_a_note() {
    let mut bytes = mini_chunk();
    // Local headers have the checksum at byte 14, those of the directory at byte 16.
    for (signature, at) in [(b"PK\x03\x04", 14), (b"PK\x01\x02", 16)] {
        let starts: Vec<usize> = (0..bytes.len() - 4).filter(|start| bytes[*start..].starts_with(signature)).collect();
        for start in starts {
            bytes[start + at..][..4].fill(0);
        }
    }
    let (folder, source) = with_chunk(&bytes, &["00000000000000a1", "00000000000000a2"]);
    assert_eq!(source.frame(0, 3).unwrap(), re10k_mini(Split::Train).frame(0, 3).unwrap());
    let filters = SceneFilters { min_frames: 2, ..ALL };
    let report = ChunkSource::open(folder.path(), Split::Train, &filters).unwrap().report;
    assert_eq!(report.notes, ["1 file without checksums: damage would not be noticed"]);
}

#[test]
fn invalid_fields_of_view_are_refused() {
    for limit in [f64::NAN, f64::INFINITY, 0.0, -1.0] {
        let filters = SceneFilters { min_frames: 0, max_fov_deg: Some(limit) };
        let message = filters.validate().unwrap_err().to_string();
        assert_eq!(message, format!("`max_fov_deg` = {limit}: use a positive number such as 100"));
        assert!(ChunkSource::open(&fixture("re10k-mini"), Split::Train, &filters).is_err());
    }
    assert!(ALL.validate().is_ok());
}

/// An archive whose pickle is a list of `scenes`, after a list of 10,000 references to one image in memo slot 2, their
/// cameras in slot 3 and their time stamps in slot 4.
fn sharing_chunk(scenes: &[u8]) -> Vec<u8> {
    let mut pickle = PickleWriter::new();
    pickle.tensor("ByteStorage", Vec::new(), &[0]);
    pickle.raw(&[b"q\x01](", b"h\x01".repeat(10_000).as_slice(), b"eq\x02"].concat());
    let row =
        Camera::to_re10k(&re10k_mini(Split::Train).cameras(0).unwrap()[0]).map(|value| (value as f32).to_le_bytes());
    pickle.tensor("FloatStorage", row.concat().repeat(10_000), &[10_000, 18]);
    pickle.raw(b"q\x03");
    pickle.tensor("LongStorage", vec![0; 80_000], &[10_000]);
    pickle.raw(&[b"q\x04](", scenes, b"e."].concat());
    pickle.pack("bomb").unwrap()
}

/// A scene with the 10,000 shared images and opcodes that give its address; the memo's slot 5 receives the address, and
/// slot 6 the scene.
fn sharing_scene(key: &str, url: &[u8]) -> Vec<u8> {
    let shared = b"X\x06\0\0\0imagesh\x02X\x07\0\0\0camerash\x03X\x0a\0\0\0timestampsh\x04";
    let length = (key.len() as u32).to_le_bytes();
    [b"}(", &shared[..], b"X\x03\0\0\0keyX", &length, key.as_bytes(), b"X\x03\0\0\0url", url, b"uq\x06"].concat()
}

#[test]
fn shared_values_cannot_fill_the_memory() {
    let message = |scenes: &[u8]| {
        let (_folder, source) = with_chunk(&sharing_chunk(scenes), &["a"]);
        source.num_frames(0).map_err(|error| error.to_string())
    };
    let empty = b"X\0\0\0\0";
    assert_eq!(message(&sharing_scene("a", empty)), Ok(10_000), "the file is readable");
    // 2,000 million frames of 24 bytes, from 400 kB.
    let repeated = [sharing_scene("a", empty), b"h\x06".repeat(200_000)].concat();
    assert!(message(&repeated).unwrap_err().contains("scene 1: key \"a\": it occurs twice"));
    let scenes: Vec<u8> = (0..1000).flat_map(|number| sharing_scene(&format!("{number}"), empty)).collect();
    assert!(message(&scenes).unwrap_err().contains("more than the limit of 131072 frames"));
    let long = [b"X\0\0\x40\0", vec![b'u'; 0x40_0000].as_slice(), b"q\x05"].concat();
    let scenes: Vec<u8> = (0..9)
        .flat_map(|number| sharing_scene(&format!("{number}"), if number == 0 { &long } else { b"h\x05" }))
        .collect();
    assert!(message(&scenes).unwrap_err().contains("more than the limit of 16777216 bytes"));
}

/// Writes `num_chunks` chunks of `num_scenes` scenes each; frames are not images.
fn write_made_up(folder: &Path, num_chunks: usize, num_scenes: usize, num_frames: usize) {
    let cameras = re10k_mini(Split::Train).cameras(0).unwrap();
    let mut index = BTreeMap::new();
    for chunk in 0..num_chunks {
        let file = format!("{chunk:06}.torch");
        let record = |scene: usize| SceneRecord {
            key: format!("scene-{chunk:05}-{scene:03}"),
            url: String::new(),
            timestamps: (0..num_frames as i64).collect(),
            cameras: (0..num_frames).map(|frame| cameras[frame % cameras.len()]).collect(),
            images: vec![vec![0; 64]; num_frames],
        };
        let scenes: Vec<SceneRecord> = (0..num_scenes).map(record).collect();
        let path = folder.join(&file);
        std::fs::write(&path, chunk_bytes(&path, &scenes).unwrap()).unwrap();
        index.extend(scenes.into_iter().map(|scene| (scene.key, file.clone())));
    }
    std::fs::write(folder.join("index.json"), serde_json::to_vec(&index).unwrap()).unwrap();
}

fn open_cached(folder: &Path, filters: &SceneFilters, progress: ScanProgress<'_>) -> ChunkSource {
    let index = read_index(&folder.join("index.json")).unwrap();
    let cache = folder.join("cache/chunk-index.json");
    let mut source = ChunkSource::of_index(folder, &index, |_| true, filters, false, Some((&cache, progress))).unwrap();
    source.record_unlisted(folder, &index);
    source
}

#[test]
fn unchanged_chunks_are_not_read_again() {
    let folder = tempfile::tempdir().unwrap();
    write_made_up(folder.path(), 3, 2, 9);
    let frames = SceneFilters { min_frames: 9, max_fov_deg: None };
    let tables_read = |source: &ChunkSource| source.chunks.iter().filter(|chunk| chunk.table.get().is_some()).count();
    let opened = |filters: &SceneFilters| {
        let source = open_cached(folder.path(), filters, &mut |_, _| ());
        let num_frames: usize = (0..source.num_scenes()).map(|scene| source.num_frames(scene).unwrap()).sum();
        (tables_read(&source), num_frames, source.report.to_string())
    };
    let all = "6 of 6 scenes used".to_owned();
    assert_eq!(opened(&frames), (3, 54, all.clone()));
    assert_eq!(opened(&frames), (0, 54, all.clone()));
    // A field of view was not asked for before.
    let wide = SceneFilters { min_frames: 9, max_fov_deg: Some(60.0) };
    assert_eq!([opened(&wide), opened(&wide), opened(&frames)], [3, 0, 0].map(|tables| (tables, 54, all.clone())));
    let narrow = opened(&SceneFilters { max_fov_deg: Some(50.0), ..wide });
    assert_eq!(narrow, (0, 0, "0 of 6 scenes used; 6 with a field of view above 50 degrees".into()));

    // Another chunk takes the place of one: its scenes are not those of the index.
    std::fs::copy(folder.path().join("000001.torch"), folder.path().join("000002.torch")).unwrap();
    let (tables, num_frames, report) = opened(&frames);
    assert_eq!((tables, num_frames), (1, 36), "{report}");
    assert!(report.contains("also in chunks other than those of index.json"), "{report}");
    assert!(report.contains("expected scene scene-00002-000, found 2 other scenes"), "{report}");
    // An unreadable chunk is read at every opening, and reported.
    std::fs::write(folder.path().join("000000.torch"), "torn").unwrap();
    for _ in 0..2 {
        let (tables, num_frames, report) = opened(&frames);
        assert_eq!((tables, num_frames), (1, 18), "{report}");
        assert!(report.contains("bad chunk: "), "{report}");
    }
}

#[test]
fn progress_counts_every_chunk() {
    let folder = tempfile::tempdir().unwrap();
    write_made_up(folder.path(), 2 * CHUNKS_PER_CALL + 3, 1, 9);
    let mut calls = Vec::new();
    let filters = SceneFilters { min_frames: 9, max_fov_deg: None };
    open_cached(folder.path(), &filters, &mut |done, total| calls.push((done, total)));
    assert_eq!(calls, [64, 128, 131].map(|done| (done, 131)));
}

/// Figures of docs/results/performance.md.
#[test]
#[ignore = "writes 3 GB; run with --ignored --nocapture for the times"]
fn start_up_of_67000_scenes_takes_two_seconds() {
    let folder = tempfile::tempdir().unwrap();
    write_made_up(folder.path(), 6700, 10, 100);
    let filters = SceneFilters { min_frames: 46, max_fov_deg: Some(100.0) };
    let times = [(); 3].map(|()| {
        let started = std::time::Instant::now();
        let source = open_cached(folder.path(), &filters, &mut |_, _| ());
        let num_frames: usize = (0..source.num_scenes()).map(|scene| source.num_frames(scene).unwrap()).sum();
        assert_eq!(num_frames, 6_700_000);
        started.elapsed().as_secs_f64()
    });
    println!("first opening {:.2} s, then {:.2} s and {:.2} s", times[0], times[1], times[2]);
    assert!(times[1..].iter().all(|time| *time < 2.0), "{times:?}");
}
