"""Compares clift's LPIPS and perceptual loss at full width with torchvision and the `lpips` package.

    .venv/bin/pip install --no-deps lpips torchvision tqdm
    .venv/bin/python scripts/check/check_vgg.py /tmp/check-vgg     # writes 140 MB, prints the command that compares

The backbones are randomly initialised, so that nothing is downloaded; the linear heads are the package's own. The
whole way is checked: the weights go through convert_vgg.py, from files as torchvision and MatConvNet write them.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import lpips
import numpy as np
import scipy.io
import torch
import torchvision
from safetensors.numpy import load_file, save_file

SCRIPTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(SCRIPTS / "twin"), str(SCRIPTS / "fixtures")]
import vgg_torch
from make_vgg_fixtures import metrics_of, perceptual_of, pictures, smooth

TWIN_TOLERANCE = 1e-9


def convert(*args: object) -> None:
    subprocess.run([sys.executable, SCRIPTS / "tools" / "convert_vgg.py", *map(str, args)], check=True)


def write_mat(weights: vgg_torch.Weights, path: Path) -> None:
    """A file with the fields of MatConvNet's: layers of a name, a type, weights {filters, biases}."""
    layers = []
    for stage, count in enumerate(vgg_torch.VGG19["convs"], 1):
        for i in range(1, count + 1):
            pair = np.empty((1, 2), object)
            pair[0, 0] = weights[f"conv{stage}_{i}.weight"].numpy().transpose(2, 3, 1, 0)
            pair[0, 1] = weights[f"conv{stage}_{i}.bias"].numpy().reshape(-1, 1)
            layers.append(dict(name=f"conv{stage}_{i}", type="conv", weights=pair))
            layers.append(dict(name=f"relu{stage}_{i}", type="relu"))
        layers.append(dict(name=f"pool{stage}", type="pool"))
    cells = np.empty((1, len(layers)), object)
    for i, layer in enumerate(layers):
        cells[0, i] = layer
    mean = np.array(vgg_torch.MEAN_RGB).reshape(1, 1, 3)
    scipy.io.savemat(path, dict(layers=cells, meta=dict(normalization=dict(averageImage=mean))))


def main() -> int:
    parser = argparse.ArgumentParser(description="Writes what the full-width comparison reads.")
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(7)

    # LPIPS: the package's own network and heads on a random backbone.
    torch.manual_seed(8)
    vgg16 = torchvision.models.vgg16(weights=None)
    for layer in vgg16.features:
        if isinstance(layer, torch.nn.Conv2d):
            torch.nn.init.normal_(layer.bias, std=0.1)
    torch.save(vgg16.state_dict(), folder / "vgg16.pth")
    heads = Path(lpips.__path__[0]) / "weights" / "v0.1" / "vgg.pth"
    convert("lpips", folder / "vgg16.pth", heads, "-o", folder / "lpips-vgg.safetensors")
    package = lpips.LPIPS(net="vgg", pnet_rand=True, pretrained=False, verbose=False)
    package.load_state_dict(torch.load(heads, map_location="cpu", weights_only=True), strict=False)
    for name, part in package.net.named_children():
        for number, layer in part.named_children():
            layer.load_state_dict(vgg16.features[int(number)].state_dict())
    package = package.double().eval()
    pairs = pictures(rng)
    for height, width in ((64, 65), (127, 95), (256, 256)):
        target = smooth(rng, height, width)
        noisy = target + 0.1 * rng.standard_normal(target.shape)
        pairs[f"size{height}x{width}"] = (noisy.astype(np.float32), target.astype(np.float32))
    found = metrics_of(pairs, lambda a, b: package(a, b, normalize=True))
    save_file(found, folder / "lpips.safetensors")

    # The twin that made the small fixtures agrees with the package.
    converted = load_file(folder / "lpips-vgg.safetensors")
    weights = {name: torch.from_numpy(values).double() for name, values in converted.items()}
    twin = metrics_of(pairs, lambda a, b: vgg_torch.lpips(weights, a, b))
    worst = max(abs(twin[k] - found[k])[0] for k in found if k.startswith("output.lpips."))
    print(f"twin and lpips package: largest difference {worst:.1e}")
    assert worst < TWIN_TOLERANCE

    # The perceptual loss.
    vgg19 = vgg_torch.random_weights(vgg_torch.VGG19["convs"], vgg_torch.FULL, 9)
    write_mat(vgg19, folder / "vgg19.mat")
    convert("vgg19", folder / "vgg19.mat", "-o", folder / "vgg19.safetensors")
    converted = load_file(folder / "vgg19.safetensors")
    assert all(np.array_equal(converted[name], values.numpy()) for name, values in vgg19.items())
    check_against_torchvision(vgg19)
    save_file(perceptual_of(vgg19, rng, (1, 2, 45, 67)), folder / "perceptual.safetensors")
    print(f"now: CLIFT_CHECK_VGG={folder} cargo test --release --workspace -- --ignored --nocapture the_full_network")
    return 0


def check_against_torchvision(weights: vgg_torch.Weights) -> None:
    """The twin's VGG-19 features are those of torchvision's layers, with average pooling in place of max."""
    network = torchvision.models.vgg19(weights=None).features
    numbers = [i for i, layer in enumerate(network) if isinstance(layer, torch.nn.Conv2d)]
    names = [f"conv{s}_{i}" for s, count in enumerate(vgg_torch.VGG19["convs"], 1) for i in range(1, count + 1)]
    for number, name in zip(numbers, names):
        network[number].weight.data, network[number].bias.data = weights[f"{name}.weight"], weights[f"{name}.bias"]
    for i, layer in enumerate(network):
        if isinstance(layer, torch.nn.MaxPool2d):
            network[i] = torch.nn.AvgPool2d(2, 2)
    x = torch.rand(1, 3, 33, 49, generator=torch.Generator().manual_seed(1))
    found = vgg_torch.features(weights, x, **vgg_torch.VGG19, pool=torch.nn.functional.avg_pool2d)
    with torch.no_grad():
        for feature, end in zip(found, (4, 9, 14, 23, 32)):
            assert torch.allclose(feature, network[:end](x), atol=1e-5), end
    print("twin and torchvision: VGG-19 features agree")


if __name__ == "__main__":
    sys.exit(main())
