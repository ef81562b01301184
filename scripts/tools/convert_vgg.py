"""Converts the weights of the perceptual networks to what clift reads. Downloads nothing.

    python3 scripts/tools/convert_vgg.py lpips vgg16-397923af.pth lpips/weights/v0.1/vgg.pth -o lpips-vgg.safetensors
    python3 scripts/tools/convert_vgg.py vgg19 imagenet-vgg-verydeep-19.mat -o vgg19.safetensors

lpips: VGG-16 as torchvision publishes it, and the linear heads that come with the `lpips` package (pip install
lpips; the file lies in its folder). For LPIPS: `eval.lpips_weights`.

vgg19: VGG-19 as MatConvNet publishes it (matconvnet/models/imagenet-vgg-verydeep-19.mat). For the training loss:
`loss.vgg_weights`.

Needs torch, numpy, safetensors, and scipy for the .mat file. Pickles are read with weights_only=True.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "twin"))
import vgg_torch

MEAN_TOLERANCE = 0.01


def conv_names(convs: tuple[int, ...]) -> list[str]:
    return [f"conv{stage}_{i}" for stage, count in enumerate(convs, 1) for i in range(1, count + 1)]


def expected_shapes(convs: tuple[int, ...], widths: tuple[int, ...] = vgg_torch.FULL) -> dict[str, tuple[int, ...]]:
    shapes, inputs = {}, 3
    for stage, (count, outputs) in enumerate(zip(convs, widths), 1):
        for i in range(1, count + 1):
            shapes[f"conv{stage}_{i}.weight"] = (outputs, inputs, 3, 3)
            shapes[f"conv{stage}_{i}.bias"] = (outputs,)
            inputs = outputs
    return shapes


def check(weights: dict[str, np.ndarray], shapes: dict[str, tuple[int, ...]]) -> None:
    for name, shape in shapes.items():
        if name not in weights:
            sys.exit(f"{name} is missing")
        if weights[name].shape != shape:
            sys.exit(f"{name} has shape {weights[name].shape}, expected {shape}")
        if not np.isfinite(weights[name]).all():
            sys.exit(f"{name} is not finite")


def load_pickle(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, map_location="cpu", weights_only=True)


def lpips_weights(vgg16: Path, heads: Path) -> dict[str, np.ndarray]:
    state = load_pickle(vgg16)
    # torchvision numbers every layer of `features`: convolution, ReLU, .., pooling.
    weights, layer = {}, 0
    for stage, count in enumerate(vgg_torch.VGG16["convs"], 1):
        for i in range(1, count + 1):
            for kind in ("weight", "bias"):
                weights[f"conv{stage}_{i}.{kind}"] = state[f"features.{layer}.{kind}"].float().numpy()
            layer += 2
        layer += 1
    for i, head in enumerate(read_heads(heads), 1):
        weights[f"head{i}.weight"] = head
    return weights


def read_heads(path: Path) -> list[np.ndarray]:
    state = load_pickle(path)
    return [state[f"lin{i}.model.1.weight"].float().reshape(-1).numpy() for i in range(5)]


def vgg19_weights(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    mat = loadmat(path, squeeze_me=True, struct_as_record=False)
    mean = mean_colour(mat)
    if mean is not None and np.abs(mean - np.array(vgg_torch.MEAN_RGB)).max() > MEAN_TOLERANCE:
        sys.exit(f"the file's mean colour is {mean}, expected {vgg_torch.MEAN_RGB}: not RGB, or another network")
    wanted, weights = set(conv_names(vgg_torch.VGG19["convs"])), {}
    for layer in np.atleast_1d(mat["layers"]):
        name = str(getattr(layer, "name", ""))
        if name not in wanted:
            continue
        # Newer files hold `weights` = {filters, biases}, older ones the two by name.
        kernel, bias = layer.weights if hasattr(layer, "weights") else (layer.filters, layer.biases)
        # [kh, kw, in, out] -> [out, in, kh, kw]
        weights[f"{name}.weight"] = np.asarray(kernel, np.float32).transpose(3, 2, 0, 1)
        weights[f"{name}.bias"] = np.asarray(bias, np.float32).reshape(-1)
    return weights


def mean_colour(mat: dict) -> np.ndarray | None:
    """The mean colour in a MatConvNet file, if the file holds one."""
    for place in ("meta", "normalization"):
        node = mat.get(place)
        node = getattr(node, "normalization", node)
        image = getattr(node, "averageImage", None)
        if image is not None:
            return np.asarray(image, np.float64).reshape(-1, 3).mean(0)
    return None


def write(weights: dict[str, np.ndarray], file_format: str, path: Path) -> None:
    tensors = {name: np.ascontiguousarray(values, np.float32) for name, values in weights.items()}
    save_file(tensors, path, metadata={"format": file_format})
    print(f"wrote {path}: {len(tensors)} tensors, SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()}")


def main() -> int:
    parser = argparse.ArgumentParser(description="Converts the weights of the perceptual networks.")
    commands = parser.add_subparsers(dest="command", required=True)
    lpips = commands.add_parser("lpips", help="VGG-16 and the heads of the lpips package")
    lpips.add_argument("vgg16", type=Path, help="torchvision's vgg16-397923af.pth")
    lpips.add_argument("heads", type=Path, help="lpips/weights/v0.1/vgg.pth")
    vgg19 = commands.add_parser("vgg19", help="VGG-19 of MatConvNet")
    vgg19.add_argument("mat", type=Path, help="imagenet-vgg-verydeep-19.mat")
    for command in (lpips, vgg19):
        command.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args()

    if args.command == "lpips":
        weights = lpips_weights(args.vgg16, args.heads)
        heads = {f"head{i}.weight": (width,) for i, width in enumerate(vgg_torch.FULL, 1)}
        check(weights, expected_shapes(vgg_torch.VGG16["convs"]) | heads)
        write(weights, "clift-lpips-vgg-1", args.out)
    else:
        weights = vgg19_weights(args.mat)
        check(weights, expected_shapes(vgg_torch.VGG19["convs"]))
        write(weights, "clift-vgg19-1", args.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
