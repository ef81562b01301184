"""Makes what the tests of clift-data read: `data-fixtures/{reference,re10k-mini,hostile}`.

    python scripts/make_data_fixtures.py [OUTPUT_DIR]

Needs torch, Pillow, numpy, scipy and safetensors. Every picture and pose is computed from a formula or a fixed seed.
The files are checked in; running this again is needed only when a fixture changes.
"""

import io
import json
import os
import pickle
import sys
import zipfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from safetensors.numpy import save_file
from scipy.spatial.transform import Rotation


def picture(height, width, phase):
    """Smooth bands with a hard-edged checkerboard in the middle: gradients, ringing and clipping in one picture."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    channels = [127.5 + 127.5 * np.sin(x * (0.11 + 0.05 * c) + y * (0.07 - 0.02 * c) + phase + c) for c in range(3)]
    rgb = np.stack(channels, axis=-1)
    middle = (abs(y - height / 2) < height / 4) & (abs(x - width / 2) < width / 4)
    checker = ((x // 3 + y // 3) % 2 * 255)[..., None]
    return np.where(middle[..., None], checker, rgb).round().astype(np.uint8)


def write_lanczos(folder):
    """Pillow's LANCZOS on small pictures, `N.input` and `N.output`, both u8 [height, width, 3]."""
    # The first four have the ratios of the protocol's table: 360x640, 270x480 and 540x960 to a height of 256.
    sizes = [
        ((72, 128), (51, 91)),
        ((54, 96), (51, 91)),
        ((108, 192), (51, 91)),
        ((45, 80), (32, 57)),
        ((37, 53), (36, 11)),
        ((97, 101), (20, 33)),
        ((50, 41), (50, 17)),  # columns only
        ((41, 50), (17, 50)),  # rows only
        ((100, 99), (3, 1)),
        ((2, 3), (1, 2)),
    ]
    tensors = {}
    for number, ((height, width), (to_height, to_width)) in enumerate(sizes):
        if number % 3 == 2:
            source = np.random.default_rng(number).integers(0, 256, (height, width, 3), dtype=np.uint8)
        else:
            source = picture(height, width, number)
        resized = Image.fromarray(source).resize((to_width, to_height), Image.LANCZOS)
        tensors[f"{number}.input"] = source
        tensors[f"{number}.output"] = np.ascontiguousarray(np.asarray(resized))
    save_file(tensors, folder / "lanczos.safetensors")


def write_fitted(folder):
    """JPEG files (`N.jpeg`, u8) and what Pillow makes of them (`N.output`, u8 [height, width, 3]): decoded, rescaled until
    they cover the size, cropped at the centre."""
    tensors = {}
    for number, ((height, width), (to_height, to_width), quality) in enumerate(
        [((180, 320), (128, 128), 90), ((160, 284), (96, 168), 80), ((240, 135), (64, 64), 95)]
    ):
        file = io.BytesIO()
        Image.fromarray(picture(height, width, number)).save(file, "JPEG", quality=quality)
        decoded = Image.open(io.BytesIO(file.getvalue()))
        scale = max(to_height / height, to_width / width)
        scaled = (round(width * scale), round(height * scale))
        row, column = (scaled[1] - to_height) // 2, (scaled[0] - to_width) // 2
        rescaled = np.asarray(decoded.resize(scaled, Image.LANCZOS))
        tensors[f"{number}.jpeg"] = np.frombuffer(file.getvalue(), np.uint8).copy()
        tensors[f"{number}.output"] = rescaled[row : row + to_height, column : column + to_width].copy()
    save_file(tensors, folder / "fitted.safetensors")


def normalized(context, target, rotation, scale):
    """Pose normalisation as the protocol writes it, with quaternions aligned to the first one."""
    if rotation == "quaternion":
        quaternions = Rotation.from_matrix(context[:, :3, :3]).as_quat()
        quaternions *= np.where(quaternions @ quaternions[0] < 0, -1.0, 1.0)[:, None]
        frame = Rotation.from_quat(quaternions.mean(0)).as_matrix()
    else:
        forward = context[:, :3, 2].mean(0)
        forward /= np.linalg.norm(forward)
        right = np.cross(context[:, :3, 1].mean(0), forward)
        right /= np.linalg.norm(right)
        frame = np.stack([right, np.cross(forward, right), forward], axis=1)
    world = np.eye(4)
    world[:3, :3] = frame
    world[:3, 3] = context[:, :3, 3].mean(0)
    moved = np.linalg.inv(world) @ np.concatenate([context, target])
    counted = moved if scale == "all" else moved[: len(context)]
    moved[:, :3, 3] /= np.abs(counted[:, :3, 3]).max()
    return moved


def write_poses(folder):
    """Normalised poses: `CASE.context`, `CASE.target` in, `CASE.ROTATION.SCALE` out; all f64 [views, 4, 4], c2w."""
    tensors = {}
    rng = np.random.default_rng(7)
    # `turned` puts the mean rotation half a turn from the world's axes, where quaternions of one sign cancel.
    for case, base in [("benign", Rotation.identity()), ("turned", Rotation.from_rotvec([0.0, np.pi, 0.0]))]:
        poses = np.tile(np.eye(4), (7, 1, 1))
        turns = rng.normal(0, 0.2, (7, 3))
        turns[:, 1] = abs(turns[:, 1]) * np.where(np.arange(7) % 2, -1, 1)  # on both sides of half a turn
        poses[:, :3, :3] = (base * Rotation.from_rotvec(turns)).as_matrix()
        poses[:, :3, 3] = rng.normal(0, 2.0, (7, 3)) + [30.0, -20.0, 10.0]
        context, target = poses[:4], poses[4:]
        tensors[f"{case}.context"] = context.copy()
        tensors[f"{case}.target"] = target.copy()
        for rotation in ["quaternion", "axes"]:
            for scale in ["context", "all"]:
                tensors[f"{case}.{rotation}.{scale}"] = normalized(context, target, rotation, scale)
    save_file(tensors, folder / "poses.safetensors")


def scene(key, phase, num_frames=8):
    """One scene of the chunk format: a camera that slides right and turns left a little."""
    cameras, images = [], []
    for frame in range(num_frames):
        rotation = Rotation.from_rotvec([0.0, -0.01 * frame, 0.0]).as_matrix()
        centre = np.array([0.1 * frame, 0.0, 0.02 * frame])
        w2c = np.concatenate([rotation.T, (-rotation.T @ centre)[:, None]], axis=1)
        cameras.append([0.9, 1.6, 0.5, 0.5, 0.0, 0.0, *w2c.flatten()])
        jpeg = io.BytesIO()
        Image.fromarray(picture(36, 64, phase + 0.2 * frame)).save(jpeg, "JPEG", quality=90)
        images.append(torch.from_numpy(np.frombuffer(jpeg.getvalue(), np.uint8).copy()))
    return {
        "url": f"https://example.org/{key}",
        "timestamps": torch.arange(num_frames, dtype=torch.int64) * 33_367 + 1_000_000,
        "cameras": torch.tensor(cameras, dtype=torch.float32),
        "images": images,
        "key": key,
    }


def write_chunks(folder):
    """Two training scenes and one test scene of eight 64x36 JPEG frames, written by torch.save."""
    for stage, keys in [("train", ["00000000000000a1", "00000000000000a2"]), ("test", ["00000000000000b1"])]:
        (folder / stage).mkdir(parents=True, exist_ok=True)
        torch.save([scene(key, float(number)) for number, key in enumerate(keys)], folder / stage / "000000.torch")
        index = dict.fromkeys(keys, "000000.torch")
        (folder / stage / "index.json").write_text(json.dumps(index, indent=1) + "\n")
    index = {
        "00000000000000b1": {"context": [0, 2, 5, 7], "target": [1, 3, 4, 6]},
        "00000000000000b2": None,
        "00000000000000b3": {},
    }
    (folder / "evaluation_index.json").write_text(json.dumps(index, indent=1) + "\n")


def write_decoded(folder, chunks):
    """Frame 3 of the second training scene as Pillow decodes it, u8 [36, 64, 3], and its c2w, f64 [4, 4]."""
    scene = torch.load(chunks / "train" / "000000.torch", weights_only=True)[1]
    w2c = np.eye(4)
    w2c[:3] = scene["cameras"][3, 6:].double().numpy().reshape(3, 4)
    frame = np.asarray(Image.open(io.BytesIO(scene["images"][3].numpy().tobytes())))
    tensors = {"frame": np.ascontiguousarray(frame), "c2w": np.ascontiguousarray(np.linalg.inv(w2c))}
    save_file(tensors, folder / "re10k_mini.safetensors")


class CallsSystem:
    """Unpickles, with Python, into a shell command."""

    def __reduce__(self):
        return os.system, ("echo unpickled",)


def write_hostile(folder):
    """A torch archive whose pickle calls os.system."""
    stream = pickle.dumps([CallsSystem()], protocol=2).replace(b"cposix\n", b"cos\n")  # the name on any platform
    with zipfile.ZipFile(folder / "calls_system.torch", "w", zipfile.ZIP_STORED) as archive:
        for name, content in [("data.pkl", stream), ("version", b"3\n")]:
            archive.writestr(zipfile.ZipInfo(f"calls_system/{name}"), content)  # fixed date: the same bytes every time


def main():
    default = Path(__file__).resolve().parent.parent / "data-fixtures"
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    for name in ["reference", "re10k-mini", "hostile"]:
        (root / name).mkdir(parents=True, exist_ok=True)
    write_lanczos(root / "reference")
    write_fitted(root / "reference")
    write_poses(root / "reference")
    write_chunks(root / "re10k-mini")
    write_decoded(root / "reference", root / "re10k-mini")
    write_hostile(root / "hostile")


if __name__ == "__main__":
    main()
