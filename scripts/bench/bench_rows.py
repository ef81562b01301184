"""What bench_pytorch.py compares: the sizes, the rows with their targets, and the sizes as keys of clift's config."""

from __future__ import annotations

from dataclasses import dataclass

# `side` is that of every view in pixels, `batch` that of training steps; all other cases use one scene.
FULL = dict(dim=768, heads=8, feed_forward=2048, encoder_blocks=6, renderer_blocks=6, condenser_blocks=2)
FULL |= dict(contexts=4, side=256, targets=1, batch=1, latents=1024)
TINY = dict(dim=128, heads=8, feed_forward=341, encoder_blocks=3, renderer_blocks=3, condenser_blocks=2)
TINY |= dict(contexts=4, side=64, targets=1, batch=8, latents=64)
SMOKE = dict(dim=64, heads=4, feed_forward=96, encoder_blocks=1, renderer_blocks=1, condenser_blocks=2)
SMOKE |= dict(contexts=4, side=32, targets=1, batch=2, latents=16)
SIZES = {"full": FULL, "tiny": TINY, "smoke": SMOKE}


@dataclass(frozen=True)
class Ours:
    """A row of `clift bench`, with what to set beyond the size."""

    work: str
    overrides: tuple[str, ...] = ()
    size: str | None = None  # None: the one asked for
    contexts: int | None = None
    is_lvsm: bool = False  # LVSM's encoder-decoder of the same sizes, with its own blocks


@dataclass(frozen=True)
class Torch:
    """A case of torch_cases.py."""

    work: str
    size: str | None = None
    precision: str = "f32"  # or "bf16": under autocast


Side = Ours | Torch


@dataclass(frozen=True)
class Row:
    """A line of the table. Rows of a group share their measurements where they name the same."""

    work: str
    group: str
    ours: Ours
    torch: Torch | None
    # Upper bounds, for the full sizes: time and memory over PyTorch's, bytes.
    targets: tuple[tuple[str, float], ...] = ()


def rows() -> list[Row]:
    def same(work: str, *targets: tuple[str, float]) -> Row:
        return Row(work, work, Ours(work), Torch(work), targets)

    def in_bf16(work: str, *targets: tuple[str, float]) -> Row:
        ours = Ours(work, ('precision="bf16"',))
        return Row(f"{work}_bf16", f"{work}_bf16", ours, Torch(work, precision="bf16"), targets)

    views, stage2 = Ours("render_8_views"), Ours("stage2_step")
    return [
        same("stage1_step", ("ratio", 1.0), ("memory_ratio", 0.7)),
        Row(
            "stage1_step_tiny",
            "stage1_step_tiny",
            Ours("stage1_step", size="tiny"),
            Torch("stage1_step", size="tiny"),
            (("ratio", 1.0),),
        ),
        same("encode", ("ratio", 0.95)),
        same("render", ("ratio", 1.0)),
        # PyTorch's fastest way, and its fastest without sharing keys and values between the views.
        same("render_8_views", ("ratio", 0.85)),
        Row("render_8_views_unshared", "render_8_views", views, Torch("render_8_views_unshared"), (("ratio", 0.85),)),
        same("stage2_step", ("ratio", 1.0)),
        Row("stage2_step_padded", "stage2_step", stage2, Torch("stage2_step_padded"), (("ratio", 0.6),)),
        same("condense", ("ratio", 0.8)),
        same("cluster_attention", ("ratio", 0.1)),
        Row("lvsm_step", "lvsm_step", Ours("stage1_step", is_lvsm=True), Torch("lvsm_step"), (("ratio", 0.9),)),
        Row("lvsm_render", "lvsm_render", Ours("render", is_lvsm=True), Torch("lvsm_render"), (("ratio", 0.9),)),
        in_bf16("stage1_step", ("ratio", 0.7), ("memory_ratio", 0.6)),
        in_bf16("stage2_step", ("ratio", 0.7)),
        in_bf16("encode", ("ratio", 0.7)),
        in_bf16("render", ("ratio", 0.7)),
        Row("growth", "growth", Ours("stage1_step", contexts=16), None, (("ours_bytes", 12e9),)),
    ]


def overrides(size: dict[str, int], is_lvsm: bool = False) -> list[str]:
    """A size as keys of clift's config."""
    contexts, side = size["contexts"], size["side"]
    # Any clip that holds the contexts will do.
    gap, frames = max(9, contexts), max(16, 2 * contexts)
    network = ["model.condenser.residual=true", f"model.condenser.num_blocks={size['condenser_blocks']}"]
    if is_lvsm:
        network = ['model.architecture="lvsm-ed"', f"model.num_latents={size['latents']}"]
        network += ["model.condenser.num_blocks=0"]
    return [
        *network,
        # PyTorch's side has none of what configs/tiny.toml adds to the paper.
        "model.patch_size=8",
        'model.camera_encoding="plucker"',
        'stage1.optimizer.algorithm="adamw"',
        'stage2.optimizer.algorithm="adamw"',
        f"model.dim={size['dim']}",
        f"model.num_heads={size['heads']}",
        f"model.feed_forward_dim={size['feed_forward']}",
        f"model.num_encoder_blocks={size['encoder_blocks']}",
        f"model.num_renderer_blocks={size['renderer_blocks']}",
        f"data.width={side}",
        f"data.height={side}",
        f"data.synthetic.width={side}",
        f"data.synthetic.height={side}",
        f"data.synthetic.num_frames={frames}",
        f"data.views.min_context={contexts}",
        f"data.views.max_context={contexts}",
        f"data.views.min_gap=[{gap},{gap}]",
        f"data.views.max_gap=[{frames - 1},{frames - 1}]",
        f"data.views.num_targets={size['targets']}",
        f"stage1.batch_size={size['batch']}",
        f"stage2.batch_size={size['batch']}",
        "stage1.accumulate=1",
        "stage2.accumulate=1",
        "stage1.keep_tokens=[1.0,1.0]",
    ]
