"""Compares clift's decoding, rescaling and cropping with Pillow's: `python scripts/check/check_pillow.py DIR [--size 256x256]`.

DIR holds JPEG or PNG files, or chunks (`*.torch`), at any depth; `--jpeg 4:2:0` stores them as JPEG of that chroma first.
Builds and runs the example `fit_frame` of clift-data. Prints, for each chroma that the files have, the mean and the
largest absolute difference in grey levels, and exits with 1 where the mean of a picture is 0.5 or more. Of PNG files the
difference is zero: the resize is Pillow's, bit for bit. JPEG decoders differ by a level or two, and by more where they
enlarge the chroma (4:2:2, 4:2:0).
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, JpegImagePlugin

ROOT = Path(__file__).resolve().parents[2]
# Mean absolute difference in grey levels that a file may have.
LIMIT = 0.5
# Chroma of JPEG files, by Pillow's numbers.
CHROMA = {0: "4:4:4", 1: "4:2:2", 2: "4:2:0"}
# Quality that `--jpeg` stores with.
QUALITY = 95


def chroma(file: bytes) -> str:
    """How much of the chroma a JPEG file keeps; PNG files keep all."""
    picture = Image.open(io.BytesIO(file))
    if picture.format != "JPEG":
        return str(picture.format)
    return "JPEG " + CHROMA.get(JpegImagePlugin.get_sampling(picture), "of another chroma")


def as_jpeg(file: bytes, subsampling: str) -> bytes:
    """The picture of a file, stored as JPEG."""
    out = io.BytesIO()
    picture = Image.open(io.BytesIO(file)).convert("RGB")
    picture.save(out, "JPEG", quality=QUALITY, subsampling=subsampling)
    return out.getvalue()


def pictures(folder: Path, limit: int) -> list[bytes]:
    """The files of at most `limit` pictures, spread over those there are."""
    files = [p.read_bytes() for p in sorted(folder.rglob("*")) if p.suffix.lower() in {".jpg", ".jpeg", ".png"}]
    chunks = sorted(folder.rglob("*.torch"))
    if chunks:
        import torch

        for chunk in chunks:
            scenes = torch.load(chunk, weights_only=True)
            for scene in scenes if isinstance(scenes, list) else [scenes]:
                files.extend(image.numpy().tobytes() for image in scene["images"])
    step = max(1, len(files) // limit)
    return files[::step][:limit]


def fitted(file: bytes, width: int, height: int) -> np.ndarray:
    """pixelSplat's protocol with Pillow: rescale until it just covers the size, crop the centre."""
    picture = Image.open(io.BytesIO(file)).convert("RGB")
    scale = max(height / picture.height, width / picture.width)
    scaled = (round(picture.width * scale), round(picture.height * scale))
    rescaled = np.asarray(picture.resize(scaled, Image.LANCZOS))
    row, column = (scaled[1] - height) // 2, (scaled[0] - width) // 2
    return rescaled[row : row + height, column : column + width]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", default="256x256")
    parser.add_argument("--limit", type=int, default=200, help="most pictures")
    parser.add_argument("--jpeg", choices=CHROMA.values(), help="store the pictures as JPEG of this chroma first")
    parser.add_argument("--example", type=Path, help="the built example, instead of building it")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    command = ["cargo", "run", "--quiet", "--release", "-p", "clift-data", "--example", "fit_frame", "--"]
    command = [str(args.example)] if args.example else command
    files = pictures(args.folder, args.limit)
    if args.jpeg:
        files = [as_jpeg(file, args.jpeg) for file in files]
    if not files:
        sys.exit(f"no pictures in {args.folder}")
    found: dict[str, list[tuple[float, int]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        names = []
        for number, file in enumerate(files):
            names += [f"{scratch}/{number}.in", f"{scratch}/{number}.png"]
            Path(names[-2]).write_bytes(file)
        subprocess.run([*command, args.size, *names], check=True, cwd=ROOT)
        for file, name in zip(files, names[1::2]):
            ours = np.asarray(Image.open(name)).astype(int)
            difference = np.abs(ours - fitted(file, width, height).astype(int))
            found.setdefault(chroma(file), []).append((float(difference.mean()), int(difference.max())))
    for kind, differences in sorted(found.items()):
        means = [mean for mean, _ in differences]
        print(
            f"{len(means)} pictures at {args.size}, {kind}: mean absolute difference {np.mean(means):.4f} grey levels "
            f"(worst picture {max(means):.4f}), largest difference of a value {max(most for _, most in differences)}"
        )
    sys.exit(int(any(mean >= LIMIT for differences in found.values() for mean, _ in differences)))


if __name__ == "__main__":
    main()
