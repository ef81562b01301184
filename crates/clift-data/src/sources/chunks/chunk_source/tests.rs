use super::*;
use crate::sources::chunks::index::index_of_files;
use crate::sources::chunks::writer::{SceneRecord, chunk_bytes, write_chunks};
use crate::testing::{fixture, re10k_mini};
use crate::torch::pickle_writer::PickleWriter;
use safetensors::SafeTensors;

const ALL: SceneFilters = SceneFilters { min_frames: 0, max_fov_deg: None };

/// Opens a training split of one chunk, whose index has these keys.
fn open_chunk(bytes: &[u8], keys: &[&str]) -> (tempfile::TempDir, ChunkSource) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("train")).unwrap();
    std::fs::write(folder.path().join("train/000000.torch"), bytes).unwrap();
    let index: BTreeMap<_, _> = keys.iter().map(|key| (*key, "000000.torch")).collect();
    std::fs::write(folder.path().join("train/index.json"), serde_json::to_vec(&index).unwrap()).unwrap();
    let source = ChunkSource::open(folder.path(), Split::Train, &ALL).unwrap();
    (folder, source)
}

/// Returns the number of frames of a scene of a chunk, or the error.
fn num_frames(bytes: &[u8], key: &str) -> Result<usize, String> {
    open_chunk(bytes, &[key]).1.num_frames(0).map_err(|error| error.to_string())
}

fn mini_chunk() -> Vec<u8> {
    std::fs::read(fixture("re10k-mini/train/000000.torch")).unwrap()
}

#[test]
fn chunks_of_torch_save_are_read_by_frame() {
    let source = re10k_mini(Split::Train);
    assert_eq!(source.num_scenes(), 2);
    assert_eq!(source.report.to_string(), "all 2 scenes used");
    let scene = source.find("00000000000000a2").unwrap();
    assert_eq!(source.key(scene), "00000000000000a2");
    let bytes = std::fs::read(fixture("reference/re10k_mini.safetensors")).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let frame = source.frame(scene, 3).unwrap();
    let expected = tensors.tensor("frame").unwrap();
    assert_eq!(expected.shape(), [frame.height, frame.width, 3]);
    let worst = frame.rgb.iter().zip(expected.data()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(worst <= Some(4), "{worst:?}"); // JPEG decoders round differently, chroma most
    let expected: Vec<f64> =
        tensors.tensor("c2w").unwrap().data().as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
    let c2w = source.cameras(scene).unwrap()[3].c2w.to_matrix_f64().map(|value| value as f32);
    for (got, expected) in c2w.iter().zip(&expected) {
        assert!((f64::from(*got) - expected).abs() < 1e-6, "{got} against {expected}"); // f32 file, f32 matrix
    }
}

#[test]
fn bad_chunks_are_named_with_the_problem() {
    let mini = mini_chunk();
    let truncated = |length: usize| mini[..length].to_vec();
    let empty = SceneRecord { key: "a".to_owned(), cameras: Vec::new(), images: Vec::new() };
    for (bytes, key, expected) in [
        (truncated(10), "a", "truncated"),
        (truncated(mini.len() / 2), "a", "truncated"),
        (truncated(mini.len() - 10), "a", "truncated"),
        (std::fs::read(fixture("hostile/calls_system.torch")).unwrap(), "a", "`os.system`"),
        (mini.clone(), "00ff", "expected scene 00ff, found 2 other scenes"),
        (chunk_bytes("a".as_ref(), &[empty]).unwrap(), "a", "scene a has no frames"),
    ] {
        let message = num_frames(&bytes, key).unwrap_err();
        assert!(message.contains(expected) && message.ends_with("000000.torch"), "{expected}: {message}");
    }
}

#[test]
fn flipped_bits_are_found_by_checksum() {
    let mut bytes = mini_chunk();
    let start = bytes.windows(4).position(|window| window == b"\xff\xd8\xff\xe0").unwrap();
    bytes[start + 700] ^= 1;
    let (_folder, source) = open_chunk(&bytes, &["00000000000000a1"]);
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
    for (index, expected) in [
        ("[1, 2]", "expected a map from scene keys to chunk files"),
        (r#"{"a": "../../secret.torch"}"#, "expected a file beside the index"),
        (r#"{"a": ""}"#, r#"scene a is in "", expected a file beside the index"#),
        (r#"{"a": "000000.torch"}"#, "opening a chunk that index.json lists failed"),
    ] {
        std::fs::write(folder.path().join("test/index.json"), index).unwrap();
        assert!(open().contains(expected), "{}", open());
    }
    assert!(open().ends_with("000000.torch"), "{}", open());
    std::fs::create_dir(folder.path().join("test/000000.torch")).unwrap();
    let expected = "bad chunk: a folder, which index.json lists as a chunk: ";
    assert!(open().starts_with(expected) && open().ends_with("000000.torch"), "{}", open());
}

#[test]
fn scenes_of_failing_chunks_are_skipped_with_the_error() {
    let (folder, _) = open_chunk(&mini_chunk(), &[]);
    let index = r#"{"00000000000000a1": "000000.torch", "00000000000000a2": "2.torch"}"#;
    std::fs::write(folder.path().join("train/index.json"), index).unwrap();
    let filters = SceneFilters { min_frames: 8, ..ALL };
    for (is_there, reason) in [(false, "1 opening a chunk that index.json lists failed: "), (true, "1 bad chunk: ")] {
        if is_there {
            std::fs::write(folder.path().join("train/2.torch"), &mini_chunk()[..3000]).unwrap();
        }
        let source = ChunkSource::open(folder.path(), Split::Train, &filters).unwrap();
        assert_eq!((source.num_scenes(), source.key(0)), (1, "00000000000000a1"));
        assert!(source.find("00000000000000a2").is_none() && source.frame(0, 0).is_ok());
        let report = source.report.to_string();
        assert!(report.starts_with(&format!("1 of 2 scenes used; {reason}")) && report.contains("2.torch"), "{report}");
    }
}

#[test]
fn frames_whose_cameras_cannot_be_used_are_skipped_and_odd_cameras_noted() {
    let folder = tempfile::tempdir().unwrap();
    let source = re10k_mini(Split::Train);
    let records = (0..2).map(|scene| {
        let mut cameras = source.cameras(scene).unwrap();
        if scene == 0 {
            cameras[3].c2w.translation[1] = f64::NAN;
        } else {
            for camera in &mut cameras {
                camera.c2w.rotation *= 4.0;
            }
            cameras[5].c2w.translation[1] = 1e5;
        }
        let images = (0..8).map(|frame| source.encoded_frame(scene, frame).unwrap().unwrap()).collect();
        Ok(SceneRecord { key: source.key(scene).into(), cameras, images })
    });
    write_chunks(&folder.path().join("train"), records, u64::MAX).unwrap();
    let whole = source;
    let source = ChunkSource::open(folder.path(), Split::Train, &ALL).unwrap();
    let scene = source.find("00000000000000a1").unwrap();
    assert_eq!((source.num_scenes(), source.num_frames(scene).unwrap()), (2, 7));
    let [skip] = &source.report.frames[..] else { panic!("{}", source.report) };
    assert!(skip.frame == "3" && skip.reason.starts_with("whose camera cannot be used: bad camera: "), "{skip:?}");
    let [scaled, far] = &source.report.notes[..] else { panic!("{}", source.report) };
    assert!(scaled.starts_with("1 scene with scaled rotations") && scaled.contains("a2)"), "{scaled}");
    assert!(far.starts_with("1 scene with cameras far from the others") && far.contains("a2)"), "{far}");
    assert_eq!(source.cameras(scene).unwrap()[3], whole.cameras(0).unwrap()[4]);
    assert_eq!(source.frame(scene, 3).unwrap(), whole.frame(0, 4).unwrap());
}

/// A chunk of one scene of two frames, with a further entry of raw opcodes.
fn odd_chunk(extra: &[u8]) -> Vec<u8> {
    let source = re10k_mini(Split::Train);
    let mut pickle = PickleWriter::new();
    pickle.raw(b"](}(");
    pickle.string("key");
    pickle.string("a");
    pickle.raw(extra);
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
    for (what, extra) in [
        ("int64 tensor", entry("timestamps", &tensor("LongStorage", 16))),
        ("int32 tensor", entry("timestamps", &tensor("IntStorage", 8))),
        ("list", entry("timestamps", b"](K\x01K\x02e")),
        ("numpy array", entry("depth", numpy)),
        ("bool tensor", entry("mask", &tensor("BoolStorage", 2))),
        ("bf16 tensor", entry("x", &tensor("BFloat16Storage", 4))),
        ("torch.Size", entry("size", b"ctorch\nSize\n(K\x04K\x05t\x85R")),
        ("bytes", entry("raw", b"C\x03abc")),
        ("set", entry("set", b"\x8f(K\x01K\x02\x90")),
        ("Path", entry("path", b"cpathlib\nPosixPath\nX\x01\0\0\0a\x85R")),
    ] {
        let (_folder, source) = open_chunk(&odd_chunk(&extra), &["a"]);
        assert!(source.frame(0, 1).is_ok() && source.cameras(0).is_ok(), "{what}");
        let note = "1 scene without time stamps as int64: frames count 0, 1, .. (a)";
        assert_eq!(source.report.notes == [note], what != "int64 tensor", "{what}: {}", source.report);
    }
    let call = entry("x", b"cbuiltins\neval\nX\x02\0\0\0ls\x85R");
    let message = num_frames(&odd_chunk(&call), "a").unwrap_err();
    assert!(message.contains("`builtins.eval`") && message.contains("no code was run"), "{message}");
}

#[test]
fn chunks_without_checksums_are_read() {
    let mut bytes = mini_chunk();
    // Local headers have the checksum at byte 14, those of the directory at byte 16.
    for (signature, at) in [(b"PK\x03\x04", 14), (b"PK\x01\x02", 16)] {
        let starts: Vec<usize> = (0..bytes.len() - 4).filter(|start| bytes[*start..].starts_with(signature)).collect();
        for start in starts {
            bytes[start + at..][..4].fill(0);
        }
    }
    let (_folder, source) = open_chunk(&bytes, &["00000000000000a1", "00000000000000a2"]);
    assert_eq!(source.frame(0, 3).unwrap(), re10k_mini(Split::Train).frame(0, 3).unwrap());
    assert_eq!(source.report.notes, ["1 file without checksums: damage would not be noticed"]);
}

#[test]
fn unchanged_chunks_are_not_read_again() {
    let (folder, mini) = (tempfile::tempdir().unwrap(), re10k_mini(Split::Train));
    let record = |number: usize| {
        let cameras = mini.cameras(0).unwrap();
        Ok(SceneRecord { key: format!("scene-{number}"), images: vec![vec![0; 64]; cameras.len()], cameras })
    };
    write_chunks(folder.path(), (0..3).map(record), 1).unwrap();
    let opened = |filters: SceneFilters| {
        let (index, cache) = (folder.path().join("index.json"), folder.path().join("cache/chunk-index.json"));
        let index = read_index(&index).unwrap();
        let source =
            ChunkSource::of_index(folder.path(), &index, &filters, false, Some(&cache), &mut |_, _| ()).unwrap();
        let num_frames: usize = (0..source.num_scenes()).map(|scene| source.num_frames(scene).unwrap()).sum();
        let num_tables = source.chunks.iter().filter(|chunk| chunk.table.get().is_some()).count();
        (num_tables, num_frames, source.report.to_string())
    };
    let all = "all 3 scenes used".to_owned();
    let frames = SceneFilters { min_frames: 8, max_fov_deg: None };
    assert_eq!([(); 2].map(|()| opened(frames.clone())), [3, 0].map(|tables| (tables, 24, all.clone())));
    // A field of view was not asked for before.
    let wide = SceneFilters { max_fov_deg: Some(60.0), ..frames.clone() };
    assert_eq!([(); 2].map(|()| opened(wide.clone())), [3, 0].map(|tables| (tables, 24, all.clone())));
    let narrow = opened(SceneFilters { max_fov_deg: Some(50.0), ..wide });
    assert_eq!(narrow, (0, 0, "0 of 3 scenes used; 3 with a field of view above 50 degrees".into()));
    // A chunk is replaced by a copy of another, which lacks the scene of the index. Unreadable chunks are read at every opening.
    std::fs::copy(folder.path().join("000001.torch"), folder.path().join("000002.torch")).unwrap();
    let (_, num_frames, report) = opened(frames.clone());
    assert!(num_frames == 16 && report.contains("expected scene scene-2, found 1 other scene"), "{report}");
    std::fs::write(folder.path().join("000000.torch"), "torn").unwrap();
    for _ in 0..2 {
        let (_, num_frames, report) = opened(frames.clone());
        assert!(num_frames == 8 && report.contains("bad chunk: "), "{report}");
    }
}

#[test]
fn scans_report_their_progress() {
    let (folder, empty) = (tempfile::tempdir().unwrap(), chunk_bytes("".as_ref(), &[]).unwrap());
    let index: BTreeMap<_, _> = (0..131).map(|number| (format!("{number:03}"), format!("{number:03}.torch"))).collect();
    for file in index.values() {
        std::fs::write(folder.path().join(file), &empty).unwrap();
    }
    let mut calls = Vec::new();
    let mut progress = |done, total| calls.push((done, total));
    ChunkSource::of_index(folder.path(), &index, &ALL, false, None, &mut progress).unwrap();
    ChunkSource::of_index(folder.path(), &index, &ALL, true, None, &mut progress).unwrap();
    index_of_files(folder.path(), &mut SkipReport::default(), &mut progress).unwrap();
    assert_eq!(calls, [64, 128, 131, 64, 128, 131].map(|done| (done, 131)));
}

/// An archive whose pickle is a list of `scenes`, after a list of 10,000 references to one image in memo slot 2 and their
/// cameras in slot 3.
fn sharing_chunk(scenes: &[u8]) -> Vec<u8> {
    let mut pickle = PickleWriter::new();
    pickle.tensor("ByteStorage", Vec::new(), &[0]);
    pickle.raw(&[b"q\x01](", b"h\x01".repeat(10_000).as_slice(), b"eq\x02"].concat());
    let row =
        Camera::to_re10k(&re10k_mini(Split::Train).cameras(0).unwrap()[0]).map(|value| (value as f32).to_le_bytes());
    pickle.tensor("FloatStorage", row.concat().repeat(10_000), &[10_000, 18]);
    pickle.raw(&[b"q\x03](", scenes, b"e."].concat());
    pickle.pack("bomb").unwrap()
}

/// A scene with the 10,000 shared images; the memo's slot 4 receives the scene.
fn sharing_scene(key: &str) -> Vec<u8> {
    let length = (key.len() as u32).to_le_bytes();
    let shared = b"}(X\x06\0\0\0imagesh\x02X\x07\0\0\0camerash\x03X\x03\0\0\0keyX";
    [&shared[..], &length, key.as_bytes(), b"uq\x04"].concat()
}

#[test]
fn shared_values_cannot_fill_the_memory() {
    let read = |scenes: &[u8]| num_frames(&sharing_chunk(scenes), "a");
    assert_eq!(read(&sharing_scene("a")), Ok(10_000), "the file is readable");
    // 2,000 million frames of 24 bytes, from 400 kB.
    let repeated = [sharing_scene("a"), b"h\x04".repeat(200_000)].concat();
    assert!(read(&repeated).unwrap_err().contains("scene 1: key \"a\": it occurs twice"));
    let scenes: Vec<u8> = (0..1000).flat_map(|number| sharing_scene(&format!("{number}"))).collect();
    assert!(read(&scenes).unwrap_err().contains("more than the limit of 131072 frames"));
}
