#!/usr/bin/env python3
"""Trains the PyTorch twin of the paper's network on the rooms that clift trains on, and records held-out PSNR by minutes.

Stage 1 with the sizes and rates of the config at --config: AdamW, cosine decay, a random share of the tokens. All frames
are decoded before the first step, so that reading costs no time. Writes metrics.jsonl and validation.jsonl as
`clift train` does, for scripts/tools/plot_runs.py.

    clift data synth runs/rooms-32 --scenes 4096 --size 32x32
    python3 scripts/bench/train_twin.py runs/rooms-32 --steps 2000 --out runs/twin
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import time
from pathlib import Path

import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "twin"))
import clift_torch as twin  # noqa: E402

GAPS, CONTEXT, TARGETS = (9, 15), 4, 3
KEEP = (0.125, 1.0)


class Scenes:
    """Frames `[S, F, H, W, 3]` in 8 bits, intrinsics in pixels `[S, F, 4]` and poses `[S, F, 4, 4]` of a split."""

    def __init__(self, folder: Path):
        images, cameras, self.keys = [], [], []
        for path in sorted(folder.glob("*.torch")):
            for scene in torch.load(path, weights_only=True):
                pictures = [Image.open(io.BytesIO(data.numpy().tobytes())).convert("RGB") for data in scene["images"]]
                images.append(torch.stack([torch.frombuffer(bytearray(p.tobytes()), dtype=torch.uint8) for p in pictures]))
                cameras.append(scene["cameras"])
                self.keys.append(scene["key"])
                self.size = pictures[0].height, pictures[0].width
        height, width = self.size
        self.images = torch.stack(images).view(len(images), -1, height, width, 3)
        cameras = torch.stack(cameras).double()
        self.intrinsics = (cameras[..., :4] * torch.tensor([width, height, width, height])).float()
        w2c = torch.eye(4, dtype=torch.float64).repeat(*cameras.shape[:2], 1, 1)
        w2c[..., :3, :] = cameras[..., 6:].unflatten(-1, (3, 4))
        self.c2w = torch.linalg.inv(w2c)

    def batch(self, views: list[tuple[int, list[int], list[int]]]) -> twin.Batch:
        """Context and target views of (scene, contexts, targets), with normalised poses."""
        parts = []
        for scene, context, target in views:
            frames = context + target
            c2w = normalised(self.c2w[scene, frames], len(context))
            parts.append((self.images[scene, frames].float() / 255.0, self.intrinsics[scene, frames], c2w))
        images, intrinsics, c2w = (torch.stack(part) for part in zip(*parts))
        n = len(views[0][1])
        return twin.Batch(images[:, :n], intrinsics[:, :n], c2w[:, :n], images[:, n:], intrinsics[:, n:], c2w[:, n:])


def normalised(c2w: Tensor, num_context: int) -> Tensor:
    """Poses in the frame of the mean context camera, the largest coordinate of all views 1."""
    context = c2w[:num_context]
    forward = F.normalize(context[:, :3, 2].mean(0), dim=0)
    right = F.normalize(torch.linalg.cross(context[:, :3, 1].mean(0), forward), dim=0)
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    world[:3, 3] = context[:, :3, 3].mean(0)
    moved = torch.linalg.inv(world) @ c2w
    moved[:, :3, 3] /= moved[:, :3, 3].abs().max()
    return moved.float()


def sample_views(num_frames: int, generator: torch.Generator) -> tuple[list[int], list[int]]:
    """Contexts spread over a random gap, and random targets between the outer ones."""

    def integer(low: int, high: int) -> int:
        return int(torch.randint(low, high + 1, (1,), generator=generator))

    gap = integer(GAPS[0], min(GAPS[1], num_frames - 1))
    first = integer(0, num_frames - 1 - gap)
    context = [first + round(i * gap / (CONTEXT - 1)) for i in range(CONTEXT)]
    return context, [integer(first, first + gap) for _ in range(TARGETS)]


@torch.no_grad()
def validate(model: twin.Clift, scenes: Scenes, index: dict, num_scenes: int) -> float:
    """Mean PSNR over the views of the index, all tokens."""
    found = []
    for scene, key in list(enumerate(scenes.keys))[:num_scenes]:
        batch = scenes.batch([(scene, index[key]["context"], index[key]["target"])])
        lift = model.encode(batch.context_images, batch.context_intrinsics, batch.context_c2w)
        images = model.render(lift, batch.target_intrinsics, batch.target_c2w, *scenes.size).clamp(0.0, 1.0)
        mse = (images - batch.target_images).square().mean((2, 3, 4))
        found.extend((-10.0 * mse.log10()).flatten().tolist())
    return sum(found) / len(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of `clift data synth`")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--batch-size", type=int, default=8)
    parser.add_argument("--learning-rate", type=float, default=1.5e-3)
    parser.add_argument("--warm-up-steps", type=int, default=100)
    parser.add_argument("--validate-every", type=int, default=250)
    parser.add_argument("--num-scenes", type=int, default=64, help="scenes of a validation")
    parser.add_argument("--bfloat16", action="store_true", help="autocast the updates to bfloat16")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    torch.manual_seed(args.seed)
    train, test = Scenes(args.data / "train"), Scenes(args.data / "test")
    index = json.loads((args.data / "evaluation_index.json").read_text())
    model = twin.Clift(twin.ModelConfig(128, 4, 341, 3, 3))
    optimizer = twin.adamw(model, args.learning_rate)
    generator = torch.Generator().manual_seed(args.seed)
    args.out.mkdir(parents=True)
    num_tokens = CONTEXT * (train.size[0] // twin.PATCH_SIZE) * (train.size[1] // twin.PATCH_SIZE)
    with (args.out / "metrics.jsonl").open("w") as metrics, (args.out / "validation.jsonl").open("w") as validation:
        for step in range(1, args.steps + 1):
            order = torch.randint(len(train.keys), (args.batch_size,), generator=generator).tolist()
            batch = train.batch([(scene, *sample_views(train.images.shape[1], generator)) for scene in order])
            share = KEEP[0] + (KEEP[1] - KEEP[0]) * float(torch.rand(1, generator=generator))
            started = time.perf_counter()
            for group in optimizer.param_groups:
                group["lr"] = twin.learning_rate(step, args.learning_rate, args.warm_up_steps, args.steps)
            with torch.autocast("cpu", torch.bfloat16, enabled=args.bfloat16):
                loss, _ = twin.stage1_step(model, optimizer, batch, round(share * num_tokens), generator=generator)
            row = dict(step=step, stage="stage1", loss=float(loss), step_s=time.perf_counter() - started)
            print(json.dumps(row), file=metrics)
            if step % args.validate_every == 0 or step == args.steps:
                psnr = validate(model, test, index, args.num_scenes)
                print(json.dumps(dict(step=step, stage="stage1", psnr=psnr)), file=validation, flush=True)
                print(f"step {step}: {psnr:.2f} dB", flush=True)


if __name__ == "__main__":
    main()
