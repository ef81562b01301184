"""Makes the fixtures of LPIPS and of the perceptual loss in data-fixtures/reference, with narrow random networks.

    python3 scripts/make_vgg_fixtures.py            # writes four files
    python3 scripts/make_vgg_fixtures.py --check    # remakes them and compares with what is checked in

lpips_weights, perceptual_weights: networks in the format of convert_vgg.py, with other widths
lpips: input.prediction.<pair>, input.target.<pair> [H, W, 3] F32; output.{psnr,ssim,lpips}.<pair> F64
perceptual: input.rendering, input.target [B, V, H, W, 3] F32; output.loss, grad.input.rendering F64
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import load_file, save_file
from skimage.metrics import structural_similarity

import vgg_torch

REFERENCE = Path(__file__).resolve().parent.parent / "data-fixtures" / "reference"
NARROW = (4, 6, 8, 8, 10)


def smooth(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A few waves per colour, in [0, 1]."""
    y, x = np.mgrid[0:height, 0:width]
    colours = []
    for _ in range(3):
        waves = sum(np.sin(rng.uniform(0.1, 0.9) * x + rng.uniform(0.1, 0.9) * y + rng.uniform(0, 6)) for _ in range(3))
        colours.append(0.5 + waves / 6)
    return np.stack(colours, -1)


def pictures(rng: np.random.Generator) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Pairs of odd sizes: noise, noise beyond [0, 1], unrelated, identical, flat."""
    sizes = dict(noise=(37, 53), beyond=(33, 17), unrelated=(17, 31), identical=(19, 23), flat=(16, 21))
    pairs = {}
    for name, (height, width) in sizes.items():
        target = smooth(rng, height, width)
        prediction = {
            "noise": lambda: target + 0.03 * rng.standard_normal(target.shape),
            "beyond": lambda: target + 0.5 * rng.standard_normal(target.shape),
            "unrelated": lambda: smooth(rng, height, width),
            "identical": lambda: target,
            "flat": lambda: np.full_like(target, 0.25),
        }[name]()
        if name == "flat":
            target = np.full_like(target, 0.75)
        pairs[name] = (prediction.astype(np.float32), target.astype(np.float32))
    return pairs


def as_batch(picture: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(picture).double().permute(2, 0, 1)[None]


def metrics_of(pairs: dict[str, tuple[np.ndarray, np.ndarray]], distance) -> dict[str, np.ndarray]:
    """`distance` takes two batches `[1, 3, H, W]` in float64."""
    made = {}
    for name, (prediction, target) in pairs.items():
        made[f"input.prediction.{name}"], made[f"input.target.{name}"] = prediction, target
        p, t = (x.astype(np.float64) for x in (prediction, target))
        with np.errstate(divide="ignore"):
            psnr = -10 * np.log10(np.square(p.clip(0, 1) - t.clip(0, 1)).mean())
        ssim = structural_similarity(p, t, win_size=11, gaussian_weights=True, channel_axis=2, data_range=1)
        with torch.no_grad():
            apart = float(distance(as_batch(prediction), as_batch(target)))
        for metric, value in dict(psnr=psnr, ssim=ssim, lpips=apart).items():
            made[f"output.{metric}.{name}"] = np.array([value], np.float64)
    return made


def perceptual_of(weights: vgg_torch.Weights, rng: np.random.Generator, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    batch, views, height, width = shape
    target = np.stack([smooth(rng, height, width) for _ in range(batch * views)]).astype(np.float32)
    rendering = (target + 0.1 * rng.standard_normal(target.shape)).astype(np.float32)
    rendering, target = (torch.from_numpy(x.reshape(batch, views, height, width, 3)) for x in (rendering, target))
    x = rendering.double().requires_grad_()
    loss = vgg_torch.perceptual({k: v.double() for k, v in weights.items()}, x, target.double())
    loss.backward()
    return {
        "input.rendering": rendering.numpy(),
        "input.target": target.numpy(),
        "output.loss": loss.detach().reshape(1).numpy(),
        "grad.input.rendering": x.grad.numpy(),
    }


def as_numpy(weights: vgg_torch.Weights) -> dict[str, np.ndarray]:
    return {name: values.numpy() for name, values in weights.items()}


def make() -> dict[str, tuple[dict[str, np.ndarray], str]]:
    lpips = vgg_torch.random_weights(vgg_torch.VGG16["convs"], NARROW, 1) | vgg_torch.random_heads(NARROW, 2)
    double = {name: values.double() for name, values in lpips.items()}
    vgg19 = vgg_torch.random_weights(vgg_torch.VGG19["convs"], NARROW, 3)
    metrics = metrics_of(pictures(np.random.default_rng(4)), lambda a, b: vgg_torch.lpips(double, a, b))
    return {
        "lpips_weights": (as_numpy(lpips), "clift-lpips-vgg-1"),
        "perceptual_weights": (as_numpy(vgg19), "clift-vgg19-1"),
        "lpips": (metrics, "fixture"),
        "perceptual": (perceptual_of(vgg19, np.random.default_rng(5), (2, 1, 19, 23)), "fixture"),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description="Makes the fixtures of LPIPS and of the perceptual loss.")
    parser.add_argument("--check", action="store_true", help="compare with what is checked in; write nothing")
    args = parser.parse_args()
    torch.set_num_threads(1)
    failures = 0
    for name, (tensors, file_format) in make().items():
        path = REFERENCE / f"{name}.safetensors"
        if not args.check:
            save_file({k: np.ascontiguousarray(v) for k, v in tensors.items()}, path, metadata={"format": file_format})
            print(f"wrote {path.name}: {path.stat().st_size} bytes")
            continue
        kept = load_file(path)
        same = kept.keys() == tensors.keys() and all(
            np.array_equal(kept[k], v) if v.dtype == np.float32 else np.allclose(kept[k], v, rtol=1e-9, atol=1e-12)
            for k, v in tensors.items()
        )
        failures += not same
        print(f"{name}: {'agrees' if same else 'differs'}")
    return failures


if __name__ == "__main__":
    sys.exit(main())
