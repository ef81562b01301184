"""Makes the parity fixtures in data-fixtures/reference, all of them, deterministically.

    python3 -m venv .venv
    .venv/bin/pip install -r scripts/requirements.txt
    .venv/bin/python scripts/make_fixtures.py            # self-tests, then writes every file
    .venv/bin/python scripts/make_fixtures.py --check    # remakes them and compares with what is checked in

Names inside a file:
    input.*            what goes in; sizes that a shape does not show, as I64 of length 1
    weight.<path>      weights under the Rust module's path, PyTorch layout [out, in]
    output.*           what must come out
    grad.input.*       gradient of sum(output * input.cotangent) w.r.t. that input
    grad.weight.*      the same w.r.t. that weight (model.safetensors: gradient of output.loss)

Inputs and weights are F32, integers I64. Outputs and gradients are computed in
float64 from those F32 values and stored as F64. The one exception is
patches.safetensors, whose outputs are rearranged inputs: F32, to be equal bit by bit.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy
import scipy
import skimage
import sklearn
import torch
import torch.nn as nn
import torch.nn.functional as F
from scipy.special import ndtr
from skimage.metrics import structural_similarity
from sklearn.cluster import KMeans
from threadpoolctl import threadpool_limits

import clift_torch as twin

REFERENCE = Path(__file__).resolve().parent.parent / "data-fixtures" / "reference"
MADE_WITH = (
    f"scripts/make_fixtures.py; torch {torch.__version__.split('+')[0]}, numpy {np.__version__}, "
    f"scipy {scipy.__version__}, scikit-image {skimage.__version__}, scikit-learn {sklearn.__version__}"
)

# Small, and all different, so that a wrong transpose or reshape cannot pass.
DIM, NUM_HEADS, FEED_FORWARD_DIM = 16, 4, 24

# Files of make_data_fixtures.py and make_vgg_fixtures.py in the same folder.
OTHERS = {"lanczos", "poses", "re10k_mini", "lpips", "lpips_weights", "perceptual", "perceptual_weights"}

Fixture = dict[str, np.ndarray]


# --------------------------------------------------------------- helpers


def f32(values) -> torch.Tensor:
    """Rounds to f32 and returns float64, so that the stored F32 input is what was computed with."""
    return torch.as_tensor(np.asarray(values, dtype=np.float32)).double()


def normal(rng: np.random.Generator, *shape: int, scale: float = 1.0) -> torch.Tensor:
    return f32(rng.standard_normal(shape) * scale)


def randomise(module: nn.Module, rng: np.random.Generator) -> nn.Module:
    """Gives every weight a random f32 value, norms, biases and the zero-initialised gate included."""
    module.double()
    for path, (parameter, rows) in twin.rust_parameters(module).items():
        shape = parameter[rows].shape
        if "norm" in path:
            mean, scale = (1.0 if path.endswith("weight") else 0.0), 0.2
        elif path.endswith("bias"):
            mean, scale = 0.0, 0.2
        else:
            mean, scale = 0.0, 1.0 / math.sqrt(shape[1])
        with torch.no_grad():
            parameter[rows] = f32(mean + scale * rng.standard_normal(shape))
    return module


def random_cameras(rng: np.random.Generator, batch: int, views: int, height: int, width: int):
    """Random rotations, translations in [-1, 1], non-square pixels, off-centre principal points."""
    quaternion = rng.standard_normal((batch, views, 4))
    w, x, y, z = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rotation = np.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        -1,
    ).reshape(batch, views, 3, 3)  # fmt: skip
    c2w = np.zeros((batch, views, 4, 4))
    c2w[..., :3, :3] = rotation
    c2w[..., :3, 3] = rng.uniform(-1.0, 1.0, (batch, views, 3))
    c2w[..., 3, 3] = 1.0
    focal = rng.uniform(0.7, 1.4, (batch, views, 2)) * [width, height]
    centre = rng.uniform(0.4, 0.6, (batch, views, 2)) * [width, height]
    return f32(np.concatenate([focal, centre], -1)), f32(c2w)


def smooth_images(rng: np.random.Generator, count: int, height: int, width: int) -> np.ndarray:
    """Random low-frequency pictures `[count, H, W, 3]` within [0.1, 0.9]."""
    y, x = np.meshgrid(np.linspace(0, 1, height), np.linspace(0, 1, width), indexing="ij")
    images = np.zeros((count, height, width, 3))
    for _ in range(4):
        fy, fx, phase = rng.uniform(-3, 3, (3, count, 1, 1, 3))
        images += np.cos(2 * np.pi * (fy * y[None, ..., None] + fx * x[None, ..., None] + phase))
    return 0.5 + 0.1 * images


def integer(value: int) -> np.ndarray:
    return np.array([value], dtype=np.int64)


def inputs(**tensors: torch.Tensor) -> Fixture:
    fixture = {}
    for name, tensor in tensors.items():
        array = tensor.detach().numpy()
        rounded = array.astype(np.float32)
        assert np.array_equal(rounded, array), f"input.{name} is not an f32 value"
        fixture[f"input.{name}"] = rounded
    return fixture


def outputs(**tensors: torch.Tensor) -> Fixture:
    return {f"output.{name}": tensor.detach().double().numpy() for name, tensor in tensors.items()}


def weights(module: nn.Module) -> Fixture:
    fixture = {}
    for path, tensor in twin.export_state(module).items():
        rounded = tensor.numpy().astype(np.float32)
        assert np.array_equal(rounded, tensor.numpy()), f"weight.{path} is not an f32 value"
        fixture[f"weight.{path}"] = rounded
    return fixture


def gradients(module: nn.Module | None = None, **tensors: torch.Tensor) -> Fixture:
    fixture = {f"grad.input.{name}": tensor.grad.numpy() for name, tensor in tensors.items()}
    if module is not None:
        fixture |= {f"grad.weight.{path}": grad.numpy() for path, grad in twin.export_gradients(module).items()}
    return fixture


def split_heads(x: torch.Tensor, num_heads: int) -> torch.Tensor:
    """`[B, N, H*d]` to `[B, H, N, d]`: a head's channels lie next to each other."""
    return x.unflatten(-1, (num_heads, -1)).transpose(1, 2)


# -------------------------------------------------------------- fixtures


def make_rays() -> Fixture:
    intrinsics, c2w = random_cameras(np.random.default_rng(1), 2, 3, 16, 24)
    return inputs(intrinsics=intrinsics, c2w=c2w) | outputs(plucker=twin.plucker(intrinsics, c2w, 16, 24))


def make_patches() -> Fixture:
    rng = np.random.default_rng(2)
    images = f32(rng.uniform(0, 1, (2, 3, 16, 24, 3)))
    rays = normal(rng, 2, 3, 16, 24, 6)
    pixels_patches = f32(rng.uniform(0, 1, (2, 3 * 2 * 3, 192)))
    fixture = inputs(images=images, plucker=rays, pixels_patches=pixels_patches)
    rearranged = outputs(
        context_patches=twin.context_patches(images, rays),
        ray_patches=twin.patchify(rays),
        pixels=twin.unpatchify(pixels_patches, 16, 24),
    )
    return fixture | {name: array.astype(np.float32) for name, array in rearranged.items()}


def attention(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, num_heads: int):
    """Plain softmax attention; returns the output `[B, M, H*d]` and the scores' log-sum-exp `[B, H, M]`."""
    q, k, v = (split_heads(x, num_heads) for x in (q, k, v))
    scores = q @ k.mT / math.sqrt(q.shape[-1])
    output = scores.softmax(-1) @ v
    return output.transpose(1, 2).flatten(-2), scores.logsumexp(-1)


def extreme_logits(rng: np.random.Generator, num_heads: int):
    """Queries and keys with scores of about 1e4 whose attention is still well defined in f32.

    q and k are integers, keys 3 and 7 are equal. The best score of a row leads
    the next different one by more than 100, or it is the exact tie of keys 3
    and 7; so the weights are 1, or 1/2 and 1/2, in any precision.
    """
    while True:
        q = torch.from_numpy(np.round(rng.standard_normal((2, 7, 32)) * 64))
        k = torch.from_numpy(np.round(rng.standard_normal((2, 11, 32)) * 64))
        k[:, 7] = k[:, 3]
        scores = split_heads(q, num_heads) @ split_heads(k, num_heads).mT / math.sqrt(32 / num_heads)
        different = torch.cat([scores[..., :7], scores[..., 8:]], -1).sort(-1, descending=True).values
        ties = scores.argmax(-1) == 3
        if (different[..., 0] - different[..., 1]).min() > 100 and ties.any() and scores.abs().max() > 1e4:
            return q, k


def make_sdpa() -> Fixture:
    rng, num_heads = np.random.default_rng(3), 4
    fixture = {"input.num_heads": integer(num_heads)}
    q, k, v = normal(rng, 2, 7, 32), normal(rng, 2, 11, 32), normal(rng, 2, 11, 32)
    cases = {"": (q, k, v), "extreme_": (*extreme_logits(rng, num_heads), normal(rng, 2, 11, 32))}
    for case, (q, k, v) in cases.items():
        cotangent = normal(rng, 2, 7, 32)
        for x in (q, k, v):
            x.requires_grad_()
        output, log_sum_exp = attention(q, k, v, num_heads)
        (output * cotangent).sum().backward()
        named = {f"{case}q": q, f"{case}k": k, f"{case}v": v}
        fixture |= inputs(**named, **{f"{case}cotangent": cotangent})
        fixture |= outputs(**{f"{case}output": output, f"{case}log_sum_exp": log_sum_exp})
        fixture |= gradients(**named)
    return fixture


def make_encoder_block() -> Fixture:
    rng = np.random.default_rng(4)
    block = randomise(twin.encoder_block(DIM, NUM_HEADS, FEED_FORWARD_DIM), rng)
    x = normal(rng, 2, 24, DIM).requires_grad_()
    cotangent = normal(rng, 2, 24, DIM)
    output = block(x)
    (output * cotangent).sum().backward()
    fixture = inputs(x=x, cotangent=cotangent) | weights(block) | outputs(x=output) | gradients(block, x=x)
    return fixture | {"input.num_heads": integer(NUM_HEADS)}


def make_decoder_block() -> Fixture:
    rng = np.random.default_rng(5)
    block = randomise(twin.decoder_block(DIM, NUM_HEADS, FEED_FORWARD_DIM), rng)
    x = normal(rng, 2, 10, DIM).requires_grad_()
    memory = normal(rng, 2, 24, DIM).requires_grad_()
    cotangent = normal(rng, 2, 10, DIM)
    output = block(x, memory)
    (output * cotangent).sum().backward()
    fixture = inputs(x=x, memory=memory, cotangent=cotangent) | weights(block) | outputs(x=output)
    return fixture | gradients(block, x=x, memory=memory) | {"input.num_heads": integer(NUM_HEADS)}


def make_model() -> Fixture:
    rng = np.random.default_rng(6)
    config = twin.ModelConfig(
        dim=DIM,
        num_heads=NUM_HEADS,
        feed_forward_dim=FEED_FORWARD_DIM,
        num_encoder_blocks=2,
        num_renderer_blocks=2,
    )
    model = randomise(twin.Clift(config), rng)
    context_intrinsics, context_c2w = random_cameras(rng, 2, 3, 16, 24)
    target_intrinsics, target_c2w = random_cameras(rng, 2, 2, 16, 24)
    batch = dict(
        context_images=f32(smooth_images(rng, 6, 16, 24).reshape(2, 3, 16, 24, 3)),
        context_intrinsics=context_intrinsics,
        context_c2w=context_c2w,
        target_images=f32(smooth_images(rng, 4, 16, 24).reshape(2, 2, 16, 24, 3)),
        target_intrinsics=target_intrinsics,
        target_c2w=target_c2w,
    )
    lift = model.encode(batch["context_images"], context_intrinsics, context_c2w)
    rendering = model.render(lift, target_intrinsics, target_c2w, 16, 24)
    loss = twin.stage1_loss(model, twin.Batch(**batch))
    loss.backward()
    fixture = inputs(**batch) | weights(model) | gradients(model)
    fixture |= outputs(lift=lift, rendering=rendering, loss=loss[None])
    return fixture | {"input.num_heads": integer(NUM_HEADS)}


def uneven_clusters(rng: np.random.Generator, sizes: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Shuffled tokens in clusters of the given sizes, the centroid a random member."""
    order = rng.permutation(sum(sizes))
    assignment = np.empty(sum(sizes), dtype=np.int64)
    centroid_index = []
    for cluster, members in enumerate(np.split(order, np.cumsum(sizes)[:-1])):
        assignment[members] = cluster
        centroid_index.append(rng.choice(members))
    return assignment, np.array(centroid_index, dtype=np.int64)


def make_condenser(residual: bool) -> Fixture:
    rng = np.random.default_rng(7)
    condenser = randomise(twin.Condenser(DIM, NUM_HEADS, 2, FEED_FORWARD_DIM, residual), rng)
    rng = np.random.default_rng(70)  # both variants see the same tokens and clusters
    clusters = [uneven_clusters(rng, [13, 1, 2, 9, 5, 10]), uneven_clusters(rng, [3, 17, 1, 1, 12, 6])]
    assignment, centroid_index = (np.stack(arrays) for arrays in zip(*clusters))
    lift = normal(rng, 2, 40, DIM).requires_grad_()
    cotangent = normal(rng, 2, 6, DIM)
    clift = condenser(lift, torch.from_numpy(assignment), torch.from_numpy(centroid_index))
    (clift * cotangent).sum().backward()
    fixture = inputs(lift=lift, cotangent=cotangent) | weights(condenser) | outputs(clift=clift)
    fixture |= gradients(condenser, lift=lift)
    return fixture | {
        "input.num_heads": integer(NUM_HEADS),
        "input.assignment": assignment,
        "input.centroid_index": centroid_index,
    }


def make_metrics() -> Fixture:
    """Pairs, in order: light noise, strong noise (out of [0, 1]), two unrelated pictures, black and
    white, saturated in part, identical, both black. PSNR clamps both to [0, 1], SSIM does not clamp."""
    rng, height, width = np.random.default_rng(8), 20, 26
    smooth = smooth_images(rng, 5, height, width)
    black, white = np.zeros((height, width, 3)), np.ones((height, width, 3))
    pairs = [
        (smooth[0] + 0.02 * rng.standard_normal((height, width, 3)), smooth[0]),
        (smooth[1] + 0.4 * rng.standard_normal((height, width, 3)), smooth[1]),
        (smooth[2], smooth[3]),
        (black, white),
        (np.clip(3 * smooth[4] - 1, 0, 1), np.clip(2 * smooth[4] - 0.3, 0, 1)),
        (smooth[0], smooth[0]),
        (black, black),
    ]
    prediction, target = (f32(np.stack(images)) for images in zip(*pairs))
    mse = (prediction.clamp(0, 1) - target.clamp(0, 1)).square().mean((1, 2, 3))
    ssim = [
        structural_similarity(p, t, win_size=11, gaussian_weights=True, channel_axis=2, data_range=1)
        for p, t in zip(prediction.numpy(), target.numpy())
    ]
    return inputs(prediction=prediction, target=target) | outputs(
        psnr=-10 * mse.log10(), ssim=torch.tensor(ssim, dtype=torch.float64)
    )


def blob_features(rng: np.random.Generator) -> torch.Tensor:
    """512 samples of 12 blobs of uneven size and spread, `[512, 16]`."""
    share = rng.dirichlet(np.full(12, 2.0))
    blob = rng.choice(12, size=512, p=share)
    centre, spread = rng.standard_normal((12, 16)) * 3, rng.uniform(0.2, 1.0, 12)
    return f32(centre[blob] + rng.standard_normal((512, 16)) * spread[blob, None])


def encoder_like_features(rng: np.random.Generator) -> torch.Tensor:
    """Features that vary smoothly over 4 views of 16 x 16 patches, with a little noise, `[1024, 32]`."""
    view, y, x = np.meshgrid(np.arange(4), np.arange(16) / 16, np.arange(16) / 16, indexing="ij")
    place = np.stack([view * 0.3, y, x], -1).reshape(1024, 3)
    features = np.cos(2 * np.pi * (place @ rng.standard_normal((3, 32)) + rng.uniform(0, 1, 32)))
    features = features * np.geomspace(2.0, 0.2, 32) + 0.05 * rng.standard_normal((1024, 32))
    return f32(features)


def make_kmeans() -> Fixture:
    """Inertia of scikit-learn's K-means (one k-means++ start, Lloyd) for seeds 0..39."""
    rng, counts, num_seeds = np.random.default_rng(9), (8, 64, 256), 40
    fixture = {"input.num_clusters": np.array(counts, dtype=np.int64)}
    for name, features in dict(blobs=blob_features(rng), encoder_like=encoder_like_features(rng)).items():
        inertia = np.empty((len(counts), num_seeds))
        num_iterations = np.empty((len(counts), num_seeds), dtype=np.int64)
        for i, count in enumerate(counts):
            for seed in range(num_seeds):
                fit = KMeans(count, init="k-means++", n_init=1, random_state=seed, algorithm="lloyd")
                fit.fit(features.numpy())
                inertia[i, seed], num_iterations[i, seed] = fit.inertia_, fit.n_iter_
        fixture |= inputs(**{name: features})
        fixture |= {
            f"output.{name}_inertia": inertia,
            f"output.{name}_inertia_mean": inertia.mean(1),
            f"output.{name}_inertia_best": inertia.min(1),
            f"output.{name}_num_iterations": num_iterations,
        }
    return fixture


def make_adamw() -> Fixture:
    """Five AdamW steps on two parameters with given gradients, the learning rates, and clipping."""
    rng, num_steps = np.random.default_rng(10), 5
    schedule = dict(base=1e-3, warmup_steps=3, total_steps=10)
    lr = [twin.learning_rate(step, **schedule) for step in range(1, 11)]

    start = dict(a=normal(rng, 4, 3), b=normal(rng, 5))
    grads = dict(a=normal(rng, num_steps, 4, 3), b=normal(rng, num_steps, 5))
    grads["a"][:, 0, 0] = 0.0  # moves by weight decay alone
    grads["b"][:, 0] *= 2.0**-30  # about as small as eps
    params = {name: nn.Parameter(value.clone()) for name, value in start.items()}
    optimizer = torch.optim.AdamW(params.values(), lr=lr[0], betas=(0.9, 0.95), eps=1e-8, weight_decay=0.05)
    history = {name: [] for name in params}
    for step in range(num_steps):
        optimizer.param_groups[0]["lr"] = lr[step]
        for name, parameter in params.items():
            parameter.grad = grads[name][step].clone()
        optimizer.step()
        for name, parameter in params.items():
            history[name].append(parameter.detach().clone())

    fixture = inputs(param_a=start["a"], param_b=start["b"], grad_a=grads["a"], grad_b=grads["b"])
    fixture |= outputs(**{f"param_{name}": torch.stack(steps) for name, steps in history.items()})
    fixture |= outputs(lr=torch.tensor(lr, dtype=torch.float64))

    # Clipping to a global norm of 1: one set of gradients above it, one below.
    for case, scale in dict(large=2.0, small=0.05).items():
        clipped = [nn.Parameter(torch.zeros(4, 3).double()), nn.Parameter(torch.zeros(5).double())]
        for parameter in clipped:
            parameter.grad = normal(rng, *parameter.shape, scale=scale)
        fixture |= inputs(**{f"clip_{case}_a": clipped[0].grad, f"clip_{case}_b": clipped[1].grad})
        norm = nn.utils.clip_grad_norm_(clipped, max_norm=1.0)
        fixture |= outputs(
            **{f"clip_{case}_a": clipped[0].grad, f"clip_{case}_b": clipped[1].grad, f"clip_{case}_norm": norm[None]}
        )
    return fixture


def make_gelu() -> Fixture:
    """Exact GELU, x * Phi(x), and its derivative.

    Phi comes from scipy's ndtr, which keeps its relative precision in the left tail, where
    0.5 * (1 + erf(x / sqrt(2))) has none left.
    """
    special = [0.0, -0.0, 1e-30, -1e-30, 1e-8, -1e-8, 1e-4, -1e-4, 1e4, -1e4, 3e38, -3e38]
    x = f32(np.concatenate([np.linspace(-30, 30, 241), np.linspace(-3, 3, 97), special]))
    cdf = torch.from_numpy(ndtr(x.numpy()))
    density = torch.exp(-x.square() / 2) / math.sqrt(2 * math.pi)
    return inputs(x=x) | outputs(gelu=x * cdf, derivative=cdf + x * density)


FIXTURES = {
    "rays": make_rays,
    "patches": make_patches,
    "sdpa": make_sdpa,
    "encoder_block": make_encoder_block,
    "decoder_block": make_decoder_block,
    "model": make_model,
    "condenser": lambda: make_condenser(residual=False),
    "condenser_residual": lambda: make_condenser(residual=True),
    "metrics": make_metrics,
    "kmeans": make_kmeans,
    "adamw": make_adamw,
    "gelu": make_gelu,
}


# ------------------------------------------------------------ self-tests
#
# Each recomputes a fixture another way: loops in numpy, library functions, or
# the exported weights under their Rust names with nothing but matrix products.


def close(name: str, actual, expected, tolerance: float = 1e-12) -> None:
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape, f"{name}: {actual.shape} is not {expected.shape}"
    error = np.abs(actual - expected).max() / max(1.0, np.abs(expected).max())
    assert error <= tolerance, f"{name}: relative error {error:.2e} is over {tolerance:.0e}"


class Weights:
    """The exported weights of a fixture, applied by path."""

    def __init__(self, fixture: Fixture, prefix: str = ""):
        self.fixture, self.prefix = fixture, f"weight.{prefix}"

    def get(self, path: str) -> np.ndarray:
        return self.fixture[self.prefix + path].astype(np.float64)

    def has(self, path: str) -> bool:
        return self.prefix + path in self.fixture

    def linear(self, path: str, x: np.ndarray) -> np.ndarray:
        bias = self.get(f"{path}.bias") if self.has(f"{path}.bias") else 0.0
        return x @ self.get(f"{path}.weight").T + bias

    def norm(self, path: str, x: np.ndarray) -> np.ndarray:
        centred = x - x.mean(-1, keepdims=True)
        scaled = centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-5)
        return scaled * self.get(f"{path}.weight") + self.get(f"{path}.bias")

    def feed_forward(self, x: np.ndarray) -> np.ndarray:
        hidden = self.linear("feed_forward.up", x)
        return self.linear("feed_forward.down", hidden * ndtr(hidden))

    def self_attention(self, path: str, x: np.ndarray) -> np.ndarray:
        q, k, v = np.split(self.linear(f"{path}.in_proj", x), 3, -1)
        return self.linear(f"{path}.out_proj", plain_attention(q, k, v))

    def cross_attention(self, path: str, x: np.ndarray, memory: np.ndarray) -> np.ndarray:
        q = self.linear(f"{path}.q_proj", x)
        k, v = np.split(self.linear(f"{path}.kv_proj", memory), 2, -1)
        return self.linear(f"{path}.out_proj", plain_attention(q, k, v))


def plain_attention(q: np.ndarray, k: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Attention of `[M, D]` over `[N, D]`, one head and one query at a time."""
    output = np.empty((q.shape[0], v.shape[1]))
    head_dim = q.shape[1] // NUM_HEADS
    for head in range(NUM_HEADS):
        channels = slice(head * head_dim, (head + 1) * head_dim)
        for row in range(q.shape[0]):
            score = k[:, channels] @ q[row, channels] / math.sqrt(head_dim)
            weight = np.exp(score - score.max())
            output[row, channels] = (weight / weight.sum()) @ v[:, channels]
    return output


def plain_encoder_block(w: Weights, x: np.ndarray) -> np.ndarray:
    x = x + w.self_attention("attn", w.norm("norm_attn", x))
    return x + w.feed_forward(w.norm("norm_ff", x))


def plain_decoder_block(w: Weights, x: np.ndarray, memory: np.ndarray) -> np.ndarray:
    x = x + w.self_attention("self_attn", w.norm("norm_self", x))
    x = x + w.cross_attention("cross_attn", w.norm("norm_cross", x), memory)
    return x + w.feed_forward(w.norm("norm_ff", x))


def test_rays(fixture: Fixture) -> None:
    intrinsics, c2w = fixture["input.intrinsics"].astype(float), fixture["input.c2w"].astype(float)
    expected = np.empty_like(fixture["output.plucker"])
    for scene, view, row, column in np.ndindex(*expected.shape[:4]):
        fx, fy, cx, cy = intrinsics[scene, view]
        ray = np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0])
        direction = c2w[scene, view, :3, :3] @ (ray / np.linalg.norm(ray))
        moment = np.cross(c2w[scene, view, :3, 3], direction)
        expected[scene, view, row, column] = [*moment, *direction]
    close("rays", fixture["output.plucker"], expected)


def test_patches(fixture: Fixture) -> None:
    images, rays = fixture["input.images"], fixture["input.plucker"]
    context, ray = fixture["output.context_patches"], fixture["output.ray_patches"]
    pixels, pixels_patches = fixture["output.pixels"], fixture["input.pixels_patches"]
    for b, v, row, column in np.ndindex(2, 3, 16, 24):
        token = v * 6 + (row // 8) * 3 + column // 8
        at = (row % 8) * 8 + column % 8
        joined = np.concatenate([images[b, v, row, column], rays[b, v, row, column]])
        assert np.array_equal(context[b, token, at * 9 : at * 9 + 9], joined)
        assert np.array_equal(ray[b, token, at * 6 : at * 6 + 6], rays[b, v, row, column])
        assert np.array_equal(pixels[b, v, row, column], pixels_patches[b, token, at * 3 : at * 3 + 3])


def test_sdpa(fixture: Fixture) -> None:
    for case in ("", "extreme_"):
        q, k, v = (torch.from_numpy(fixture[f"input.{case}{x}"]).double().requires_grad_() for x in "qkv")
        heads = (split_heads(x, 4) for x in (q, k, v))
        output = F.scaled_dot_product_attention(*heads).transpose(1, 2).flatten(-2)
        (output * torch.from_numpy(fixture[f"input.{case}cotangent"])).sum().backward()
        close(f"{case}sdpa", fixture[f"output.{case}output"], output.detach())
        for name, x in zip("qkv", (q, k, v)):
            close(f"{case}sdpa grad {name}", fixture[f"grad.input.{case}{name}"], x.grad, 1e-9)
    # nn.MultiheadAttention with identity projections splits heads in the same way.
    layer = nn.MultiheadAttention(32, 4, batch_first=True).double()
    with torch.no_grad():
        layer.in_proj_weight.copy_(torch.eye(32).repeat(3, 1))
        layer.out_proj.weight.copy_(torch.eye(32))
    q, k, v = (torch.from_numpy(fixture[f"input.{x}"]).double() for x in "qkv")
    close("MultiheadAttention", fixture["output.output"], layer(q, k, v)[0].detach())


def test_encoder_block(fixture: Fixture) -> None:
    expected = [plain_encoder_block(Weights(fixture), x) for x in fixture["input.x"].astype(float)]
    close("encoder block", fixture["output.x"], expected)


def test_decoder_block(fixture: Fixture) -> None:
    pairs = zip(fixture["input.x"].astype(float), fixture["input.memory"].astype(float))
    expected = [plain_decoder_block(Weights(fixture), x, memory) for x, memory in pairs]
    close("decoder block", fixture["output.x"], expected)


def test_model(fixture: Fixture) -> None:
    """Scene by scene and target by target, from patches to pixels."""
    w = Weights(fixture)
    read = {name: torch.from_numpy(fixture[f"input.{name}"]).double() for name in twin.Batch.__annotations__}
    rays = twin.plucker(read["context_intrinsics"], read["context_c2w"], 16, 24)
    context = twin.context_patches(read["context_images"], rays).numpy()
    target_rays = twin.plucker(read["target_intrinsics"], read["target_c2w"], 16, 24)
    rendering = np.empty_like(fixture["output.rendering"])
    for scene in range(2):
        lift = w.linear("encoder.patch_embed", context[scene])
        for i in range(2):
            lift = plain_encoder_block(Weights(fixture, f"encoder.blocks.{i}."), lift)
        close("lift", fixture["output.lift"][scene], lift)
        for target in range(2):
            x = twin.patchify(target_rays[scene : scene + 1, target : target + 1])[0].numpy()
            x = w.linear("renderer.ray_embed", x)
            for i in range(2):
                x = plain_decoder_block(Weights(fixture, f"renderer.blocks.{i}."), x, lift)
            x = w.linear("renderer.to_pixels", w.norm("renderer.output_norm", x))
            pixels = torch.from_numpy(1 / (1 + np.exp(-x)))[None]
            rendering[scene, target] = twin.unpatchify(pixels, 16, 24)[0, 0].numpy()
    close("rendering", fixture["output.rendering"], rendering)
    close("loss", fixture["output.loss"], [np.mean((rendering - read["target_images"].numpy()) ** 2)])


def test_condenser(fixture: Fixture) -> None:
    """Cluster by cluster, each with the list of its own keys."""
    for scene, lift in enumerate(fixture["input.lift"].astype(float)):
        assignment = fixture["input.assignment"][scene]
        centroid_index = fixture["input.centroid_index"][scene]
        centroids = lift[centroid_index]
        for i in range(2):
            w = Weights(fixture, f"blocks.{i}.")
            residual = w.has("norm_cross.weight")
            x = w.self_attention("self_attn", w.norm("norm_self", centroids))
            if residual:
                x = centroids + x
            y = x.copy()
            for k, centroid in enumerate(centroid_index):
                keys = [n for n in np.flatnonzero(assignment == k) if n != centroid]
                if not keys:
                    continue
                query = w.norm("norm_cross", x[k : k + 1]) if residual else x[k : k + 1]
                gathered = w.cross_attention("cluster_attn", query, w.norm("norm_memory", lift[keys]))[0]
                y[k] = x[k] + gathered if residual else gathered
            z = w.feed_forward(w.norm("norm_ff", y))
            if residual:
                z = y + z
            centroids = centroids + w.linear("gate", z)
        close("condenser", fixture["output.clift"][scene], centroids)


def test_metrics(fixture: Fixture) -> None:
    """SSIM by hand: 11 taps, sigma 1.5, sample covariance (121/120), 5 pixels cut off on each side."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(taps, taps) / taps.sum() ** 2

    def blur(image: np.ndarray) -> np.ndarray:
        view = np.lib.stride_tricks.sliding_window_view(image, (11, 11), axis=(0, 1))
        return np.einsum("hwcij,ij->hwc", view, window)

    expected = []
    for p, t in zip(fixture["input.prediction"].astype(float), fixture["input.target"].astype(float)):
        mean_p, mean_t = blur(p), blur(t)
        var_p, var_t, cov = (
            (blur(x) - m) * 121 / 120
            for x, m in ((p * p, mean_p**2), (t * t, mean_t**2), (p * t, mean_p * mean_t))
        )
        above = (2 * mean_p * mean_t + 0.01**2) * (2 * cov + 0.03**2)
        below = (mean_p**2 + mean_t**2 + 0.01**2) * (var_p + var_t + 0.03**2)
        expected.append((above / below).mean())
    close("ssim", fixture["output.ssim"], expected, 1e-9)
    psnr = fixture["output.psnr"]
    assert psnr[3] == 0.0 and np.isinf(psnr[5:]).all() and np.isfinite(psnr[:5]).all()


def test_adamw(fixture: Fixture) -> None:
    lr = fixture["output.lr"]
    assert abs(lr[2] - 1e-3) < 1e-18 and abs(lr[9]) < 1e-18 and (np.diff(lr[2:]) < 0).all()
    for name in "ab":
        p = fixture[f"input.param_{name}"].astype(float)
        m, v = np.zeros_like(p), np.zeros_like(p)
        for step, g in enumerate(fixture[f"input.grad_{name}"].astype(float)):
            m, v = 0.9 * m + 0.1 * g, 0.95 * v + 0.05 * g * g
            m_hat, v_hat = m / (1 - 0.9 ** (step + 1)), v / (1 - 0.95 ** (step + 1))
            p = p * (1 - lr[step] * 0.05) - lr[step] * m_hat / (np.sqrt(v_hat) + 1e-8)
            close("adamw", fixture[f"output.param_{name}"][step], p)
    for case in ("large", "small"):
        both = [fixture[f"input.clip_{case}_{x}"].astype(float) for x in "ab"]
        norm = math.sqrt(sum((g**2).sum() for g in both))
        assert (norm > 1.0) == (case == "large")
        for name, g in zip("ab", both):
            # torch divides by norm + 1e-6
            close("clip", fixture[f"output.clip_{case}_{name}"], g * min(1.0, 1.0 / (norm + 1e-6)))


def test_gelu(fixture: Fixture) -> None:
    x = torch.from_numpy(fixture["input.x"]).double().requires_grad_()
    y = F.gelu(x)
    y.sum().backward()
    moderate = np.abs(fixture["input.x"]) <= 30
    close("gelu", fixture["output.gelu"][moderate], y.detach().numpy()[moderate], 1e-14)
    close("gelu derivative", fixture["output.derivative"][moderate], x.grad.numpy()[moderate], 1e-14)


def test_rust_paths() -> None:
    """Every torch parameter is exported exactly once, and loading undoes exporting."""
    config = twin.ModelConfig(DIM, NUM_HEADS, FEED_FORWARD_DIM, 2, 2, 2, condenser_residual=True)
    model = randomise(twin.Clift(config, condenser=True), np.random.default_rng(0))
    state = twin.export_state(model)
    assert sum(t.numel() for t in state.values()) == sum(p.numel() for p in model.parameters())
    other = twin.Clift(config, condenser=True).double()
    twin.load_state(other, state)
    for mine, theirs in zip(model.parameters(), other.parameters(), strict=True):
        assert torch.equal(mine, theirs)


def test_gate_starts_at_zero() -> None:
    """A fresh condenser returns the centroids as they are."""
    lift = normal(np.random.default_rng(0), 1, 9, DIM)
    index = torch.tensor([[4, 0, 8]])
    assignment = torch.tensor([[1, 0, 0, 0, 0, 0, 2, 2, 2]])
    for residual in (False, True):
        condenser = twin.Condenser(DIM, NUM_HEADS, 2, FEED_FORWARD_DIM, residual).double()
        close("fresh condenser", condenser(lift, assignment, index).detach(), lift[:, index[0]])


def test_stage1_step(fixture: Fixture) -> None:
    """The training step trains: on one batch, with dropped tokens, the loss falls."""
    torch.manual_seed(0)
    model = twin.Clift(twin.ModelConfig(DIM, NUM_HEADS, FEED_FORWARD_DIM, 2, 2))
    batch = twin.Batch(**{name: torch.from_numpy(fixture[f"input.{name}"]) for name in twin.Batch.__annotations__})
    optimizer = twin.adamw(model, lr=3e-3)
    losses = [twin.stage1_step(model, optimizer, batch, num_render_tokens=9)[0].item() for _ in range(30)]
    assert losses[-1] < 0.7 * losses[0], losses


def test_gradients(fixture: Fixture, forward) -> None:
    """Compares the stored gradients with a central difference along a random direction, one tensor at a time."""
    rng = np.random.default_rng(11)
    names = [name.removeprefix("grad.") for name in fixture if name.startswith("grad.")]
    values = {name: fixture[name].astype(np.float64) for name in names}
    for name in names:
        direction = rng.standard_normal(values[name].shape)
        direction /= np.linalg.norm(direction)
        step = 1e-5
        ahead = forward(values | {name: values[name] + step * direction})
        behind = forward(values | {name: values[name] - step * direction})
        stored = fixture[f"grad.{name}"]
        error = abs((ahead - behind) / (2 * step) - (stored * direction).sum())
        size = np.linalg.norm(stored)
        assert size > 0 and error <= 1e-6 * size, f"grad.{name}: error {error:.2e}, gradient {size:.2e}"


def module_forward(module: nn.Module, fixture: Fixture, names: list[str], extra=()):
    """The function whose gradient a block's fixture stores, of all its inputs and weights."""
    cotangent = torch.from_numpy(fixture["input.cotangent"]).double()

    def forward(values: dict[str, np.ndarray]) -> float:
        state = {k.removeprefix("weight."): torch.from_numpy(v) for k, v in values.items() if k.startswith("weight.")}
        twin.load_state(module, state)
        given = [torch.from_numpy(values[f"input.{name}"]) for name in names]
        with torch.no_grad():
            return (module(*given, *extra) * cotangent).sum().item()

    return forward


def run_self_tests(made: dict[str, Fixture]) -> None:
    test_rust_paths()
    test_gate_starts_at_zero()
    test_rays(made["rays"])
    test_patches(made["patches"])
    test_sdpa(made["sdpa"])
    test_encoder_block(made["encoder_block"])
    test_decoder_block(made["decoder_block"])
    test_model(made["model"])
    test_condenser(made["condenser"])
    test_condenser(made["condenser_residual"])
    test_stage1_step(made["model"])
    test_metrics(made["metrics"])
    test_adamw(made["adamw"])
    test_gelu(made["gelu"])

    sizes = (DIM, NUM_HEADS, FEED_FORWARD_DIM)
    block = twin.encoder_block(*sizes).double()
    test_gradients(made["encoder_block"], module_forward(block, made["encoder_block"], ["x"]))
    block = twin.decoder_block(*sizes).double()
    test_gradients(made["decoder_block"], module_forward(block, made["decoder_block"], ["x", "memory"]))
    for name, residual in dict(condenser=False, condenser_residual=True).items():
        condenser = twin.Condenser(DIM, NUM_HEADS, 2, FEED_FORWARD_DIM, residual).double()
        clusters = [torch.from_numpy(made[name][f"input.{x}"]) for x in ("assignment", "centroid_index")]
        test_gradients(made[name], module_forward(condenser, made[name], ["lift"], clusters))
    config = twin.ModelConfig(*sizes, num_encoder_blocks=2, num_renderer_blocks=2)
    model = twin.Clift(config).double()
    batch = twin.Batch(
        **{name: torch.from_numpy(made["model"][f"input.{name}"]).double() for name in twin.Batch.__annotations__}
    )

    def loss(values: dict[str, np.ndarray]) -> float:
        twin.load_state(model, {k.removeprefix("weight."): torch.from_numpy(v) for k, v in values.items()})
        with torch.no_grad():
            return twin.stage1_loss(model, batch).item()

    test_gradients(made["model"], loss)


# ------------------------------------------------------------------ main


def write(made: dict[str, Fixture], folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, fixture in made.items():
        tensors = {key: np.ascontiguousarray(array) for key, array in fixture.items()}
        # One metadata entry: with several, safetensors writes them in no fixed order.
        safetensors.numpy.save_file(tensors, folder / f"{name}.safetensors", metadata={"made_with": MADE_WITH})


def differences(name: str, made: Path, kept: Path) -> list[str]:
    """Lists what differs: inputs, weights and integers must be equal, F64 results equal to 1e-9."""
    if not kept.exists():
        return [f"{name}: {kept.name} is not there"]
    made_tensors, kept_tensors = safetensors.numpy.load_file(made), safetensors.numpy.load_file(kept)
    if made_tensors.keys() != kept_tensors.keys():
        return [f"{name}: other tensors: {sorted(made_tensors.keys() ^ kept_tensors.keys())}"]
    found = []
    for key, new in made_tensors.items():
        old = kept_tensors[key]
        if new.dtype != old.dtype or new.shape != old.shape:
            found.append(f"{name}: {key} was {old.dtype}{old.shape}, is now {new.dtype}{new.shape}")
        elif new.dtype == np.float64:
            finite = np.isfinite(old)
            scale = max(1.0, np.abs(old[finite]).max(initial=0.0))
            same = np.array_equal(new[~finite], old[~finite])
            if not same or np.abs(new[finite] - old[finite]).max(initial=0.0) > 1e-9 * scale:
                found.append(f"{name}: {key} differs")
        elif not np.array_equal(new, old):
            found.append(f"{name}: {key} differs")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description="Makes the parity fixtures in data-fixtures/reference.")
    parser.add_argument("--check", action="store_true", help="compare with what is checked in; write nothing there")
    parser.add_argument("--list", action="store_true", help="print every tensor's type and shape")
    args = parser.parse_args()

    # One thread: the last bits of a sum depend on how many threads share it.
    torch.set_num_threads(1)
    with threadpool_limits(1):
        made = {name: make() for name, make in FIXTURES.items()}
    run_self_tests(made)
    print("self-tests passed")
    if args.list:
        for name, fixture in made.items():
            for key, array in fixture.items():
                print(f"{name}: {key} {array.dtype} {list(array.shape)}")
    if not args.check:
        write(made, REFERENCE)
        total = sum(path.stat().st_size for path in REFERENCE.glob("*.safetensors"))
        print(f"wrote {len(made)} files, {total} bytes in all")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        write(made, Path(folder))
        found, equal = [], 0
        for name in made:
            new, old = Path(folder) / f"{name}.safetensors", REFERENCE / f"{name}.safetensors"
            found += differences(name, new, old)
            equal += old.exists() and new.read_bytes() == old.read_bytes()
        unknown = {path.stem for path in REFERENCE.glob("*.safetensors")} - made.keys() - OTHERS
        found += [f"{name}: no longer made by this script" for name in sorted(unknown)]
    print("\n".join(found) or f"all {len(made)} files agree, {equal} of them byte by byte")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
