"""Makes the checkpoints in data-fixtures/checkpoints: small networks of every variant with what they compute.

    .venv/bin/python scripts/make_checkpoints.py           # writes every file
    .venv/bin/python scripts/make_checkpoints.py --check   # remakes them and compares every tensor
    .venv/bin/python scripts/make_checkpoints.py --full F  # writes one of the published size elsewhere

`NAME.ckpt` is a checkpoint as Lightning's trainer saves one: the network below `transformer.`, a perceptual
network beside it, optimiser states and objects of a project that nobody else has. `NAME.safetensors` holds
`input.*` (F32, I64) and `output.*` (F64, computed in float64): `features` of the encoder, `clift` of given
clusters, `rendering` from those (or, without a condenser, from all tokens), and `input.sizes`, what the
checkpoint's configuration must be read as.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import safetensors.numpy
import torch
import torch.nn as nn
import torch.nn.functional as F

import pickle_stand_ins
from clift_released import PREFIX, DecoderLayer, EncoderLayer, ReleasedClift, ReleasedConfig
from make_fixtures import f32, normal, random_cameras, smooth_images, uneven_clusters

FOLDER = Path(__file__).resolve().parent.parent / "data-fixtures" / "checkpoints"
HEIGHT, WIDTH, NUM_CONTEXT, NUM_TARGETS = 16, 24, 2, 2

# Odd head counts, one to three layers, no two sizes equal.
CONFIGS = {
    "re10k": ReleasedConfig("released-re10k", 15, 3, 22, 1, 2),
    "re10k_first": ReleasedConfig("released-re10k", 10, 5, 12, 2, 1, condenser=False, convolutions=()),
    "dl3dv": ReleasedConfig("released-dl3dv", 14, 7, 20, 3, 1),
    "dl3dv_one": ReleasedConfig(
        "released-dl3dv", 9, 1, 16, 1, 3, convolutions=("linear_input", "linear_target", "patch_to_image.0")
    ),
    "paper": ReleasedConfig("paper", 12, 3, 18, 2, 1),
}


def randomise(module: nn.Module, rng: np.random.Generator) -> nn.Module:
    """Gives every parameter of a float64 module a random f32 value, norms and the gate included."""
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            mean = 1.0 if "norm" in name and name.endswith("weight") else 0.0
            scale = 0.2 if parameter.dim() == 1 else parameter.flatten(1).shape[1] ** -0.5
            parameter.copy_(f32(mean + scale * rng.standard_normal(tuple(parameter.shape))))
    return module


def network(config: ReleasedConfig, rng: np.random.Generator) -> ReleasedClift:
    """A network whose every parameter is drawn, the gate and the norms too, in float64."""
    return randomise(ReleasedClift(config).double(), rng).eval()


def checkpoint(model: ReleasedClift, rng: np.random.Generator) -> dict:
    state = {PREFIX + key: value.float() for key, value in model.state_dict().items()}
    # A perceptual network is saved with the model, and is not part of it.
    for layer in (0, 2):
        state[f"perceptual_loss.vgg.features.{layer}.weight"] = normal(rng, 4, 3, 3, 3).float()
    return pickle_stand_ins.lightning(state, next(iter(state.values())))


def reference(model: ReleasedClift, rng: np.random.Generator) -> dict[str, np.ndarray]:
    c = model.config
    context_intrinsics, context_c2w = random_cameras(rng, 1, NUM_CONTEXT, HEIGHT, WIDTH)
    target_intrinsics, target_c2w = random_cameras(rng, 1, NUM_TARGETS, HEIGHT, WIDTH)
    images = f32(smooth_images(rng, NUM_CONTEXT, HEIGHT, WIDTH))[None]
    assignment, centroid_index = uneven_clusters(rng, [1, 4, 2, 5])  # one of them a cluster of one
    assignment, centroid_index = (torch.from_numpy(np.asarray(x))[None] for x in (assignment, centroid_index))
    with torch.no_grad():
        features = model.encode(images, context_intrinsics, context_c2w)
        tokens = lift = model.lift(features)
        if model.squeezer is not None:
            tokens = model.condense(lift, assignment, centroid_index)
        rendering = model.render(tokens, target_intrinsics, target_c2w, HEIGHT, WIDTH)
    sizes = [c.dim, c.num_heads, c.feed_forward_dim, c.num_encoder_blocks, c.num_renderer_blocks]
    made = {
        "input.context_images": images.float(),
        "input.context_intrinsics": context_intrinsics.float(),
        "input.context_c2w": context_c2w.float(),
        "input.target_intrinsics": target_intrinsics.float(),
        "input.target_c2w": target_c2w.float(),
        "input.assignment": assignment,
        "input.centroid_index": centroid_index,
        "input.sizes": torch.tensor(sizes),
        "output.features": features,
        "output.rendering": rendering,
    }
    if model.squeezer is not None:
        made["output.clift"] = tokens
    return {name: np.ascontiguousarray(tensor.numpy()) for name, tensor in made.items()}


def test_layers_equal_torchs() -> None:
    """The layers without QK-norm are torch's own, by name and by number."""
    rng = np.random.default_rng(0)
    config = CONFIGS["re10k"]
    sizes = dict(dim_feedforward=config.feed_forward_dim, dropout=0.0, batch_first=True, norm_first=True)
    pairs = [
        (EncoderLayer(config), nn.TransformerEncoderLayer(config.dim, config.num_heads, activation=F.gelu, **sizes)),
        (DecoderLayer(config), nn.TransformerDecoderLayer(config.dim, config.num_heads, activation=F.gelu, **sizes)),
        (DecoderLayer(config, F.relu), nn.TransformerDecoderLayer(config.dim, config.num_heads, **sizes)),
    ]
    x, memory = normal(rng, 2, 5, config.dim), normal(rng, 2, 7, config.dim)
    for ours, theirs in pairs:
        randomise(ours.double(), rng)
        theirs.double().load_state_dict(ours.state_dict(), strict=True)
        given = (x,) if isinstance(ours, EncoderLayer) else (x, memory)
        torch.testing.assert_close(ours(*given), theirs(*given), rtol=0, atol=1e-12)


def test_norms_are_the_only_difference() -> None:
    """With gammas that undo them, QK-norm on unit rows is no norm at all: the other attention's numbers."""
    from clift_released import NormedAttention, PlainAttention

    rng = np.random.default_rng(1)
    normed, plain = NormedAttention(6, 3).double(), PlainAttention(6, 3).double()
    randomise(plain, rng)
    normed.load_state_dict(plain.state_dict(), strict=False)
    normed.q_norm.forward = normed.k_norm.forward = lambda x: x
    x, memory = normal(rng, 2, 4, 6), normal(rng, 2, 5, 6)
    hidden = torch.zeros(2, 4, 5, dtype=torch.bool)
    hidden[:, :, 3:] = True
    torch.testing.assert_close(normed(x, memory, hidden), plain(x, memory, hidden), rtol=0, atol=1e-12)


def half(model: ReleasedClift) -> dict:
    """The same keys in half precision, alternately of either kind."""
    kinds = (torch.float16, torch.bfloat16)
    state = {PREFIX + key: v.to(kinds[i % 2]) for i, (key, v) in enumerate(model.state_dict().items())}
    return {"state_dict": state}


def write(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for seed, (name, config) in enumerate(CONFIGS.items()):
        rng = np.random.default_rng(100 + seed)
        model = network(config, rng)
        torch.save(checkpoint(model, rng), folder / f"{name}.ckpt")
        safetensors.numpy.save_file(reference(model, rng), folder / f"{name}.safetensors")
        if name == "re10k_first":
            torch.save(half(model), folder / "half.ckpt")


def same(a: Path, b: Path) -> bool:
    if not b.exists():
        return False
    if a.suffix == ".safetensors":
        one, two = (safetensors.numpy.load_file(path) for path in (a, b))
        return one.keys() == two.keys() and all(np.allclose(one[key], two[key], rtol=0, atol=1e-9) for key in one)
    one, two = (pickle_stand_ins.read(str(path)) for path in (a, b))
    return one.keys() == two.keys() and all(torch.equal(one[key], two[key]) for key in one)


def main() -> int:
    parser = argparse.ArgumentParser(description="Makes the checkpoints in data-fixtures/checkpoints.")
    parser.add_argument("--check", action="store_true", help="compare with what is checked in; write nothing there")
    parser.add_argument("--full", metavar="FILE", help="write a released-re10k checkpoint of the published size")
    args = parser.parse_args()
    torch.set_num_threads(1)
    pickle_stand_ins.install()
    test_layers_equal_torchs()
    test_norms_are_the_only_difference()
    if args.full:
        rng = np.random.default_rng(0)
        torch.save(checkpoint(network(ReleasedConfig(), rng), rng), args.full)
        print(f"{args.full}: {Path(args.full).stat().st_size} bytes")
        return 0
    if not args.check:
        write(FOLDER)
        for path in sorted(FOLDER.iterdir()):
            print(f"{path.name}: {path.stat().st_size} bytes")
        return 0
    with tempfile.TemporaryDirectory() as place:
        write(Path(place))
        wrong = [path.name for path in sorted(Path(place).iterdir()) if not same(path, FOLDER / path.name)]
    print(f"differ: {wrong}" if wrong else "all files agree")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
