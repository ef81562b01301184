"""VGG features, LPIPS and the perceptual loss in plain torch, in any width: what the fixtures are made with.

Widths are a parameter so that a fixture fits a repository; `check_vgg.py` compares the full widths with
torchvision and the `lpips` package.
"""

from __future__ import annotations

import torch
import torch.nn as nn
import torch.nn.functional as F

FULL = (64, 128, 256, 512, 512)
# Convolutions per stage, and those up to the one whose output is a feature.
VGG16 = dict(convs=(2, 2, 3, 3, 3), taps=(2, 2, 3, 3, 3))
VGG19 = dict(convs=(2, 2, 4, 4, 2), taps=(2, 2, 2, 2, 2))

LPIPS_SHIFT = (-0.030, -0.088, -0.188)
LPIPS_SCALE = (0.458, 0.448, 0.450)
MEAN_RGB = (123.68, 116.779, 103.939)
PERCEPTUAL_FACTORS = (1 / 2.6, 1 / 4.8, 1 / 3.7, 1 / 5.6, 10 / 1.5)

Weights = dict[str, torch.Tensor]


def random_weights(convs: tuple[int, ...], widths: tuple[int, ...], seed: int) -> Weights:
    """Kaiming-normal weights and small biases, so that features neither vanish nor explode."""
    generator = torch.Generator().manual_seed(seed)
    weights, inputs = {}, 3
    for stage, (count, outputs) in enumerate(zip(convs, widths), 1):
        for i in range(1, count + 1):
            normal = torch.randn(outputs, inputs, 3, 3, generator=generator)
            weights[f"conv{stage}_{i}.weight"] = normal * (2 / (9 * inputs)) ** 0.5
            weights[f"conv{stage}_{i}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
            inputs = outputs
    return weights


def random_heads(widths: tuple[int, ...], seed: int) -> Weights:
    """Non-negative, as learned heads are."""
    generator = torch.Generator().manual_seed(seed)
    return {f"head{i}.weight": torch.rand(width, generator=generator) for i, width in enumerate(widths, 1)}


def features(weights: Weights, x: torch.Tensor, convs, taps, pool) -> list[torch.Tensor]:
    found = []
    for stage, (count, tap) in enumerate(zip(convs, taps), 1):
        if stage > 1:
            x = pool(x, kernel_size=2, stride=2)
        for i in range(1, count + 1):
            name = f"conv{stage}_{i}"
            x = F.relu(F.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], padding=1))
            if i == tap:
                found.append(x)
    return found


def channel(values: tuple[float, ...], like: torch.Tensor) -> torch.Tensor:
    # The constants in f32, as the package and the loss have them.
    return torch.tensor(values, dtype=torch.float32).to(like.dtype).reshape(1, 3, 1, 1)


def lpips(weights: Weights, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """`[B, 3, H, W]` in [0, 1] to `[B]`, as `lpips.LPIPS(net="vgg")(a, b, normalize=True)`."""
    stages = []
    for x in (a, b):
        x = (2 * x - 1 - channel(LPIPS_SHIFT, x)) / channel(LPIPS_SCALE, x)
        found = features(weights, x, **VGG16, pool=F.max_pool2d)
        stages.append([f / (f.square().sum(1, keepdim=True).sqrt() + 1e-10) for f in found])
    total = 0
    for i, (p, q) in enumerate(zip(*stages), 1):
        head = weights[f"head{i}.weight"].reshape(1, -1, 1, 1)
        total = total + ((p - q).square() * head).sum(1).mean((1, 2))
    return total


def perceptual(weights: Weights, rendering: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """`[B, V, H, W, 3]` in [0, 1] to a scalar."""
    sides = []
    for x in (rendering, target):
        x = 255 * x.flatten(0, 1).permute(0, 3, 1, 2) - channel(MEAN_RGB, x)
        sides.append([x, *features(weights, x, **VGG19, pool=F.avg_pool2d)])
    apart = [(p - q).abs().mean() for p, q in zip(*sides)]
    return (apart[0] + sum(f * a for f, a in zip(PERCEPTUAL_FACTORS, apart[1:]))) / 255


def torchvision_features(weights: Weights, convs: tuple[int, ...]) -> nn.Sequential:
    """The same weights as a torchvision-like `features` module: the layout that `convert_vgg.py` reads."""
    layers: list[nn.Module] = []
    for stage, count in enumerate(convs, 1):
        for i in range(1, count + 1):
            weight = weights[f"conv{stage}_{i}.weight"]
            conv = nn.Conv2d(weight.shape[1], weight.shape[0], 3, padding=1)
            conv.weight.data, conv.bias.data = weight.clone(), weights[f"conv{stage}_{i}.bias"].clone()
            layers += [conv, nn.ReLU()]
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers)
