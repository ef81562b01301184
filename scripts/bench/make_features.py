"""Writes encoder tokens to cluster: `python scripts/bench/make_features.py OUT.safetensors [options]`.

The file holds one tensor, "features" `[N, D]` in f32, of one scene with evenly spread context views. The encoder is
the PyTorch twin's, with seeded weights.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "twin"))
import clift_torch as twin
from torch_cases import cameras, pictures


def read_clip(chunk: Path, scene: int, views: int, side: int) -> tuple[Tensor, Tensor, Tensor]:
    """Pictures `[1, V, side, side, 3]`, intrinsics `[1, V, 4]` and c2w `[1, V, 4, 4]` of a clip in a chunk.

    Pictures are scaled and cut at the centre. Poses are relative to the first view, translations at most 1.
    """
    import numpy as np
    from PIL import Image

    entry = torch.load(chunk, weights_only=True)[scene]
    frames = torch.linspace(0, len(entry["images"]) - 1, views).round().int().tolist()
    images, intrinsics = [], []
    for frame in frames:
        picture = Image.open(io.BytesIO(entry["images"][frame].numpy().tobytes())).convert("RGB")
        scale = max(side / picture.width, side / picture.height)
        width, height = round(picture.width * scale), round(picture.height * scale)
        left, top = (width - side) // 2, (height - side) // 2
        picture = picture.resize((width, height), Image.Resampling.LANCZOS).crop((left, top, left + side, top + side))
        images.append(torch.from_numpy(np.asarray(picture).astype("float32") / 255.0))
        fx, fy = entry["cameras"][frame, :2].tolist()
        intrinsics.append(torch.tensor([fx * width, fy * height, side / 2, side / 2]))
    w2c = torch.eye(4).repeat(views, 1, 1)
    w2c[:, :3] = entry["cameras"][frames, 6:].reshape(views, 3, 4)
    c2w = w2c[0] @ w2c.inverse()
    c2w[:, :3, 3] /= c2w[:, :3, 3].abs().max().clamp_min(1e-8)
    return torch.stack(images)[None], torch.stack(intrinsics)[None], c2w[None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--clip", type=Path, metavar="CHUNK", help="a chunk file; without it pictures are smooth noise")
    parser.add_argument("--scene", type=int, default=0, help="which clip of the chunk")
    parser.add_argument("--contexts", type=int, default=4)
    parser.add_argument("--side", type=int, default=256, help="pixels of a view's side")
    parser.add_argument("--dim", type=int, default=768)
    parser.add_argument("--heads", type=int, default=8)
    parser.add_argument("--feed-forward", type=int, default=2048)
    parser.add_argument("--blocks", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    torch.manual_seed(args.seed)
    encoder = twin.Encoder(args.dim, args.heads, args.blocks, args.feed_forward)
    if args.clip:
        images, intrinsics, c2w = read_clip(args.clip, args.scene, args.contexts, args.side)
    else:
        images, (intrinsics, c2w) = pictures(1, args.contexts, args.side), cameras(1, args.contexts, args.side)
    with torch.inference_mode():
        features = encoder(images, twin.plucker(intrinsics, c2w, args.side, args.side))[0]
    if not features.isfinite().all():
        raise SystemExit("the features are not finite")
    save_file({"features": features.clone()}, args.out)
    print(f"{args.out}: {features.shape[0]} features of width {features.shape[1]}")


if __name__ == "__main__":
    main()
