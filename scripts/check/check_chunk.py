"""Checks that PyTorch reads chunk files and files of single scenes: `python scripts/check/check_chunk.py FILE.torch [..]`.

Loads each with `torch.load(weights_only=True)`, checks types and shapes, and decodes every picture if Pillow is there.
Prints a line per chunk; exits with an error at the first thing that does not fit the format.
"""

import io
import json
import sys
from pathlib import Path

import torch


def check_scene(scene):
    keys = {"url", "timestamps", "cameras", "images", "key"}
    assert set(scene) == keys, f"entries {sorted(scene)}, expected {sorted(keys)}"
    num_frames = len(scene["images"])
    assert num_frames > 0, "no frames"
    assert isinstance(scene["key"], str) and isinstance(scene["url"], str)
    assert scene["timestamps"].dtype == torch.int64 and scene["timestamps"].shape == (num_frames,)
    cameras = scene["cameras"]
    assert cameras.dtype == torch.float32 and cameras.shape == (num_frames, 18), tuple(cameras.shape)
    assert cameras.isfinite().all(), "cameras are not finite"
    assert (cameras[:, 4:6] == 0).all(), "placeholders are not zero"
    rotation = cameras[:, 6:].reshape(-1, 3, 4)[:, :, :3]
    defect = (rotation @ rotation.transpose(1, 2) - torch.eye(3)).abs().max().item()
    assert defect < 1e-2, f"rotations are off orthonormal ones by {defect:.2e}"
    for image in scene["images"]:
        assert image.dtype == torch.uint8 and image.dim() == 1, (image.dtype, tuple(image.shape))
    return num_frames


def sizes(scenes):
    """Sizes of all pictures, or None without Pillow."""
    try:
        from PIL import Image
    except ImportError:
        return None
    found = set()
    for scene in scenes:
        for image in scene["images"]:
            picture = Image.open(io.BytesIO(image.numpy().tobytes()))
            picture.load()
            found.add(f"{picture.format} {picture.width}x{picture.height}")
    return sorted(found)


def main():
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    for path in map(Path, sys.argv[1:]):
        scenes = torch.load(path, weights_only=True)
        # A scene by itself, named after its key, is the other layout.
        if isinstance(scenes, dict):
            assert path.stem == scenes["key"], (path.stem, scenes["key"])
            scenes = [scenes]
        assert isinstance(scenes, list), type(scenes)
        num_frames = sum(check_scene(scene) for scene in scenes)
        index = path.parent / "index.json"
        if index.exists():
            listed = json.loads(index.read_text())
            for scene in scenes:
                assert listed.get(scene["key"]) == path.name, f"index.json does not list {scene['key']} in {path.name}"
        print(f"{path}: {len(scenes)} scenes, {num_frames} frames, {sizes(scenes) or 'pictures not decoded'}")


if __name__ == "__main__":
    main()
