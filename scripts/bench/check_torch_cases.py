"""Checks torch_cases.py: every fast way gives the twin's numbers, and its attention is fused. Takes seconds."""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # torch's profiler is talkative

import torch
import torch.nn as nn
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "twin"))
import clift_torch as twin
import torch_cases as cases


def close(name: str, got: Tensor, expected: Tensor) -> None:
    error = ((got - expected).abs().max() / expected.abs().max()).item()
    if not error <= 1e-5:
        raise SystemExit(f"{name}: {error:.1e} away from the twin")
    print(f"{name}: {error:.1e} from the twin")


def main() -> None:
    """Every rewritten way against the twin in f32, on sizes where every block counts."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    size = dict(dim=96, heads=4, feed_forward=80, encoder_blocks=1, renderer_blocks=2, condenser_blocks=2)
    size |= dict(contexts=2, side=32, targets=1, batch=2, latents=16)
    model = twin.Clift(cases.model_config(size), condenser=True)
    for name, parameter in model.named_parameters():
        nn.init.normal_(parameter, mean=float("norm" in name and name.endswith("weight")), std=0.12)
    lift = torch.randn(2, cases.num_tokens(size), size["dim"])
    # Six centroids for 32 tokens, and a cluster of one.
    assignment, index = cases.clusters(2, lift, 6)
    assignment[assignment == 2] = 1
    assignment[torch.arange(2), index[:, 2]] = 2
    rays = twin.plucker(*cases.cameras(2, 1, 32), 32, 32)
    scene_rays = twin.plucker(*cases.cameras(1, 3, 32), 32, 32)
    memory = model.condenser(lift, assignment, index)
    picture = model.renderer(memory, rays)
    cases.use_fused_cluster_attention(model.condenser)
    close("condenser, fused attention", model.condenser(lift, assignment, index), memory)
    padded, padding = cases.condense_padded_self_masked(model.condenser, lift, assignment, index)
    close("condenser, padded", padded[:, : index.shape[1]], memory)
    close("renderer, padded", cases.render_padded(model.renderer, padded, padding, rays), picture)
    shared = cases.render_shared(model.renderer, lift[:1], scene_rays)
    close("renderer, shared memory", shared, model.renderer(lift[:1], scene_rays))
    for name, (make, variants) in cases.WORKS.items():
        for variant in variants:
            work = make(size, variant)
            with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
                work()
            names = {event.key.removeprefix("aten::") for event in profile.key_averages()}
            seen = sorted(key for key in names if "scaled_dot_product_" in key or "multi_head" in key)
            print(f"{name}, {variant}: {' '.join(seen)}")
            fused = any("flash" in key for key in seen) or variant.endswith("fastpath")
            if not fused or any("attention_math" in key for key in seen):
                raise SystemExit(f"{name}, {variant}: the fused attention did not run")


if __name__ == "__main__":
    main()
