"""PyTorch's side of bench_pytorch.py and gpu_bench.py: each piece of work done as fast as plain PyTorch does it.

Not run by hand: they start one process per measurement with a JSON object as its only argument, and read a JSON object
back. check_torch_cases.py compares every way with the twin. Modules and training step are the twin's
(clift_torch.py); what is written anew here is what the twin does slowly on purpose. Where PyTorch has more than one
good way, each is a variant, and the driver times them all.

Letters in shape comments are the twin's: B scenes, T target views, N tokens, S stored tokens, Q patches of a target,
D width.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.nn as nn
import torch.nn.functional as F
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "twin"))
import clift_torch as twin
import lvsm_torch as lvsm

NUM_VIEWS_OF_SCENE = 8
# The C++ encoder layer and attention that torch.nn takes in inference when it may. It is not always the faster way.
FAST_PATH = {"sdpa": False, "fastpath": True}
# Variants with `torch.compile` of encoder, condenser and renderer.
COMPILED = "compiled "

Work = Callable[[], Any]
Size = dict[str, int]


# ---------------------------------------------------------------- inputs


def cameras(batch: int, views: int, side: int) -> tuple[Tensor, Tensor]:
    """Views side by side that look along +z: intrinsics `[B, V, 4]`, c2w `[B, V, 4, 4]`."""
    intrinsics = torch.tensor([side, side, side / 2, side / 2], dtype=torch.float32).expand(batch, views, 4)
    c2w = torch.eye(4).repeat(batch, views, 1, 1)
    c2w[..., 0, 3] = torch.linspace(-1.0, 1.0, views)
    return intrinsics.contiguous(), c2w


def pictures(batch: int, views: int, side: int) -> Tensor:
    """Smooth random pictures `[B, V, H, W, 3]` in [0, 1]: what an encoder sees is not white noise."""
    coarse = torch.rand(batch * views, 3, 8, 8)
    smooth = F.interpolate(coarse, (side, side), mode="bicubic", align_corners=False).clamp(0.0, 1.0)
    return smooth.permute(0, 2, 3, 1).reshape(batch, views, side, side, 3).contiguous()


def training_batch(size: Size) -> twin.Batch:
    batch, side = size["batch"], size["side"]
    return twin.Batch(
        pictures(batch, size["contexts"], side),
        *cameras(batch, size["contexts"], side),
        pictures(batch, size["targets"], side),
        *cameras(batch, size["targets"], side),
    )


def num_tokens(size: Size) -> int:
    return size["contexts"] * (size["side"] // twin.PATCH_SIZE) ** 2


def model_config(size: Size) -> twin.ModelConfig:
    return twin.ModelConfig(
        dim=size["dim"],
        num_heads=size["heads"],
        feed_forward_dim=size["feed_forward"],
        num_encoder_blocks=size["encoder_blocks"],
        num_renderer_blocks=size["renderer_blocks"],
        num_condenser_blocks=size["condenser_blocks"],
        condenser_residual=True,
    )


def clusters(batch: int, tokens: Tensor, num_clusters: int) -> tuple[Tensor, Tensor]:
    """Random centroids and the nearest of them for every token: assignment `[B, N]`, centroid index `[B, S]`.

    K-means without its iterations: the cost of what follows depends on the counts alone.
    """
    index = torch.stack([torch.randperm(tokens.shape[1])[:num_clusters] for _ in range(batch)])
    centers = tokens.gather(1, index[..., None].expand(-1, -1, tokens.shape[-1]))
    assignment = torch.cdist(tokens, centers).argmin(-1)
    return assignment.scatter(1, index, torch.arange(num_clusters).expand(batch, -1)), index


# ------------------------------------------------ what the twin does slowly


class FusedClusterAttention(twin.ClusterAttention):
    """The twin's dense masked cluster attention through fused SDPA."""

    def forward(self, query: Tensor, memory: Tensor, mask: Tensor) -> Tensor:
        batch, _, dim = query.shape
        q = split_heads(self.q_proj(query), self.num_heads)
        k, v = (split_heads(t, self.num_heads) for t in self.kv_proj(memory).chunk(2, -1))
        has_key = mask.any(-1)  # [B, S]
        mixed = F.scaled_dot_product_attention(q, k, v, attn_mask=(mask | ~has_key[..., None])[:, None])
        mixed = mixed.transpose(1, 2).reshape(batch, -1, dim)
        return torch.where(has_key[..., None], self.out_proj(mixed), torch.zeros_like(query))


def split_heads(x: Tensor, num_heads: int) -> Tensor:
    """`[B, N, D]` to a view `[B, heads, N, D/heads]`."""
    batch, tokens, dim = x.shape
    return x.view(batch, tokens, num_heads, dim // num_heads).transpose(1, 2)


def make_condenser(size: Size) -> twin.Condenser:
    """The condenser on fused attention. Its gates are open, as ours are: they start at zero in training."""
    c = model_config(size)
    condenser = twin.Condenser(c.dim, c.num_heads, c.num_condenser_blocks, c.feed_forward_dim, c.condenser_residual)
    for block in condenser.blocks:
        nn.init.uniform_(block.gate.weight, -(c.dim**-0.5), c.dim**-0.5)
    use_fused_cluster_attention(condenser)
    return condenser


def use_fused_cluster_attention(condenser: twin.Condenser) -> None:
    """Exchanges the cluster attention of every block; the weights stay."""
    for block in condenser.blocks:
        slow = block.cluster_attn
        fused = FusedClusterAttention(slow.q_proj.in_features, slow.num_heads)
        fused.load_state_dict(slow.state_dict())
        block.cluster_attn = fused


def condense_padded(condenser: twin.Condenser, lift: Tensor, assignment: Tensor, padded_index: Tensor) -> Tensor:
    """The condenser on centroids padded to N: `padded_index` `[B, N]` repeats token 0 behind the real ones.

    As the published code batches scenes of different counts: a dense mask `[B, N, N]`, and work that does not
    depend on the count. A padded slot attends as token 0 does, and is ignored by whoever reads the result.
    """
    tokens = torch.arange(lift.shape[1])
    cluster = assignment.gather(1, padded_index)  # [B, N]
    mask = (assignment[:, None, :] == cluster[:, :, None]) & (tokens != padded_index[..., None])
    centroids = lift.gather(1, padded_index[..., None].expand(-1, -1, lift.shape[-1]))
    for block in condenser.blocks:
        centroids = block(centroids, lift, mask)
    return centroids


def condense_padded_self_masked(
    condenser: twin.Condenser, lift: Tensor, assignment: Tensor, index: Tensor
) -> tuple[Tensor, Tensor]:
    """`condense_padded`, with the padded slots hidden from the self-attention; also returns what is padding.

    `index` is `[B, S]`; returns tokens `[B, N, D]` and padding `[B, N]`, true where a slot is not a token.
    """
    batch, num_all, num_kept = *lift.shape[:2], index.shape[1]
    padded_index = F.pad(index, (0, num_all - num_kept))
    padding = (torch.arange(num_all) >= num_kept).expand(batch, -1)
    # The twin's block has no such argument: it is passed on to torch's attention from here.
    hooks = [
        block.self_attn.register_forward_pre_hook(
            lambda _, args, kwargs: (args, {**kwargs, "key_padding_mask": padding}), with_kwargs=True
        )
        for block in condenser.blocks
    ]
    try:
        return condense_padded(condenser, lift, assignment, padded_index), padding
    finally:
        for hook in hooks:
            hook.remove()


def render_padded(renderer: twin.Renderer, memory: Tensor, padding: Tensor, rays: Tensor) -> Tensor:
    """The twin's renderer on memory `[B, N, D]` of which `padding` `[B, N]` is hidden; one target per scene."""
    height, width = rays.shape[2:4]
    query = renderer.ray_embed(twin.patchify(rays))
    for block in renderer.blocks:
        query = block(query, memory, memory_key_padding_mask=padding)
    patches = torch.sigmoid(renderer.to_pixels(renderer.output_norm(query)))
    return twin.unpatchify(patches, height, width)


def render_shared(renderer: twin.Renderer, memory: Tensor, rays: Tensor) -> Tensor:
    """The twin's renderer on one scene, with keys and values of the memory made once for all its target views.

    In cross-attention every query stands alone, so the queries of all views go through it as one sequence.
    """
    _, targets, height, width, _ = rays.shape
    query = renderer.ray_embed(twin.patchify(rays.flatten(0, 1)[:, None]))  # [T, Q, D]
    for block in renderer.blocks:
        normed = block.norm1(query)
        query = query + block.self_attn(normed, normed, normed, need_weights=False)[0]
        attn, dim = block.multihead_attn, query.shape[-1]
        weight, bias = attn.in_proj_weight, attn.in_proj_bias
        q = F.linear(block.norm2(query), weight[:dim], bias[:dim]).reshape(1, -1, dim)  # [1, TQ, D]
        k, v = F.linear(memory, weight[dim:], bias[dim:]).chunk(2, -1)
        mixed = F.scaled_dot_product_attention(*(split_heads(t, attn.num_heads) for t in (q, k, v)))
        query = query + attn.out_proj(mixed.transpose(1, 2).reshape(query.shape))
        query = query + block.linear2(F.gelu(block.linear1(block.norm3(query))))
    patches = torch.sigmoid(renderer.to_pixels(renderer.output_norm(query)))
    return twin.unpatchify(patches, height, width).reshape(1, targets, height, width, twin.COLOR_CHANNELS)


# --------------------------------------------------------------- training


def adamw(groups: list[dict[str, Any]]) -> torch.optim.AdamW:
    """The twin's AdamW as one fused kernel."""
    return torch.optim.AdamW(groups, betas=(0.9, 0.95), eps=1e-8, weight_decay=0.05, fused=True)


def stage1_step(size: Size, variant: str) -> Work:
    model = twin.Clift(model_config(size))
    compile_if(variant, model.encoder, model.renderer)
    optimizer = adamw([dict(params=list(model.parameters()), lr=1e-4)])
    batch = training_batch(size)
    return lambda: twin.stage1_step(model, optimizer, batch)[0].item()


def make_lvsm(size: Size) -> lvsm.Lvsm:
    c = model_config(size)
    blocks = (c.num_encoder_blocks, c.num_renderer_blocks)
    return lvsm.Lvsm(lvsm.LvsmConfig(c.dim, c.num_heads, c.feed_forward_dim, *blocks, size["latents"]))


def lvsm_step(size: Size, variant: str) -> Work:
    model = make_lvsm(size)
    optimizer = adamw([dict(params=list(model.parameters()), lr=1e-4)])
    batch = training_batch(size)
    return lambda: twin.stage1_step(model, optimizer, batch)[0].item()


def stage2_step(size: Size, variant: str) -> Work:
    """Frozen encoder, condenser at the full rate, renderer at a tenth of it, clusters given."""
    padded, path = "padded" in variant, variant.rsplit(" ", 1)[-1]
    torch.backends.mha.set_fastpath_enabled(FAST_PATH[path])
    model = twin.Clift(model_config(size))
    model.condenser = make_condenser(size)
    model.encoder.requires_grad_(False).eval()
    compile_if(variant, model.encoder, model.condenser, model.renderer)
    trained = [*model.condenser.parameters(), *model.renderer.parameters()]
    optimizer = adamw(
        [dict(params=model.condenser.parameters(), lr=1e-4), dict(params=model.renderer.parameters(), lr=1e-5)]
    )
    batch = training_batch(size)
    height, width = batch.target_images.shape[2:4]
    with torch.no_grad():
        lift = model.encode(batch.context_images, batch.context_intrinsics, batch.context_c2w)
    assignment, index = clusters(size["batch"], lift, num_tokens(size) // 4)
    del lift

    def step() -> float:
        optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            lift = model.encode(batch.context_images, batch.context_intrinsics, batch.context_c2w)
        if padded:
            memory, padding = condense_padded_self_masked(model.condenser, lift, assignment, index)
            rays = twin.plucker(batch.target_intrinsics, batch.target_c2w, height, width)
            rendering = render_padded(model.renderer, memory, padding, rays)
        else:
            memory = model.condenser(lift, assignment, index)
            rendering = model.render(memory, batch.target_intrinsics, batch.target_c2w, height, width)
        loss = F.mse_loss(rendering, batch.target_images)
        loss.backward()
        nn.utils.clip_grad_norm_(trained, 1.0)
        optimizer.step()
        return loss.item()

    return step


# -------------------------------------------------------------- inference


def encode(size: Size, variant: str) -> Work:
    torch.backends.mha.set_fastpath_enabled(FAST_PATH[variant.removeprefix(COMPILED)])
    c, side = model_config(size), size["side"]
    encoder = twin.Encoder(c.dim, c.num_heads, c.num_encoder_blocks, c.feed_forward_dim).eval()
    compile_if(variant, encoder)
    images, (intrinsics, c2w) = pictures(1, size["contexts"], side), cameras(1, size["contexts"], side)
    return inference(lambda: encoder(images, twin.plucker(intrinsics, c2w, side, side)))


def make_renderer(size: Size) -> twin.Renderer:
    c = model_config(size)
    return twin.Renderer(c.dim, c.num_heads, c.num_renderer_blocks, c.feed_forward_dim).eval()


def render(size: Size, variant: str) -> Work:
    torch.backends.mha.set_fastpath_enabled(FAST_PATH[variant.removeprefix(COMPILED)])
    renderer, side = make_renderer(size), size["side"]
    compile_if(variant, renderer)
    count = size.get("render_tokens", num_tokens(size))
    memory, (intrinsics, c2w) = torch.randn(1, count, size["dim"]), cameras(1, 1, side)
    return inference(lambda: renderer(memory, twin.plucker(intrinsics, c2w, side, side)))


def lvsm_render(size: Size, variant: str) -> Work:
    model, side = make_lvsm(size).eval(), size["side"]
    memory, (intrinsics, c2w) = torch.randn(1, size["latents"], size["dim"]), cameras(1, 1, side)
    return inference(lambda: model.render(memory, intrinsics, c2w, side, side))


def render_8_views(size: Size, variant: str) -> Work:
    """Eight views of a scene; the driver divides by eight."""
    way, path = variant.rsplit(" ", 1)
    torch.backends.mha.set_fastpath_enabled(FAST_PATH[path])
    renderer, side = make_renderer(size), size["side"]
    memory, (intrinsics, c2w) = torch.randn(1, num_tokens(size), size["dim"]), cameras(1, NUM_VIEWS_OF_SCENE, side)

    def one_by_one() -> list[Tensor]:
        views = range(NUM_VIEWS_OF_SCENE)
        return [renderer(memory, twin.plucker(intrinsics[:, t : t + 1], c2w[:, t : t + 1], side, side)) for t in views]

    ways = {
        "batch": lambda: renderer(memory, twin.plucker(intrinsics, c2w, side, side)),
        "one by one": one_by_one,
        "shared memory": lambda: render_shared(renderer, memory, twin.plucker(intrinsics, c2w, side, side)),
    }
    return inference(ways[way])


def condense(size: Size, variant: str) -> Work:
    torch.backends.mha.set_fastpath_enabled(FAST_PATH[variant])
    condenser = make_condenser(size).eval()
    lift = torch.randn(1, num_tokens(size), size["dim"])
    assignment, index = clusters(1, lift, num_tokens(size) // 4)
    return inference(lambda: condenser(lift, assignment, index))


def cluster_attention(size: Size, variant: str) -> Work:
    """Dense masked attention of S centroids, without projections; the mask is made beforehand.

    The keys are all N tokens, as the twin's, or the N - S that are not centroids, as ours.
    """
    keys, dtype = variant.split(", ")
    heads, dim, dense = size["heads"], size["dim"], num_tokens(size)
    query, lift = torch.randn(1, dense // 4, dim), torch.randn(1, dense, dim)
    assignment, index = clusters(1, lift, query.shape[1])
    mask = twin.cluster_mask(assignment, index)
    if keys == "members":
        is_member = torch.ones(dense, dtype=torch.bool).scatter(0, index[0], False)
        lift, mask = lift[:, is_member], mask[:, :, is_member]
    has_key = mask.any(-1)
    mask = (mask | ~has_key[..., None])[:, None]
    if dtype == "float mask":
        mask = torch.zeros(mask.shape).masked_fill(~mask, -torch.inf)
    key, value = lift, torch.randn_like(lift)

    def attend() -> Tensor:
        q, k, v = (split_heads(t, heads) for t in (query, key, value))
        mixed = F.scaled_dot_product_attention(q, k, v, attn_mask=mask).transpose(1, 2).reshape(query.shape)
        return torch.where(has_key[..., None], mixed, torch.zeros_like(query))

    return inference(attend)


def inference(work: Work) -> Work:
    def run() -> Any:
        with torch.inference_mode():
            return work()

    return run


PATHS = list(FAST_PATH)
WAYS = [*PATHS, COMPILED + "sdpa"]
UNSHARED = [f"{way} {path}" for way in ("batch", "one by one") for path in PATHS]
MASKS = [f"{keys}, {mask} mask" for keys in ("all", "members") for mask in ("bool", "float")]
WORKS: dict[str, tuple[Callable[[Size, str], Work], list[str]]] = {
    "stage1_step": (stage1_step, ["sdpa", COMPILED + "sdpa"]),
    "lvsm_step": (lvsm_step, ["sdpa"]),
    "lvsm_render": (lvsm_render, ["sdpa"]),
    "stage2_step": (stage2_step, [f"exact {path}" for path in PATHS] + [COMPILED + "exact sdpa"]),
    "stage2_step_padded": (stage2_step, [f"padded {path}" for path in PATHS]),
    "encode": (encode, WAYS),
    "render": (render, WAYS),
    "render_8_views": (render_8_views, UNSHARED + [f"shared memory {path}" for path in PATHS]),
    "render_8_views_unshared": (render_8_views, UNSHARED),
    "condense": (condense, PATHS),
    "cluster_attention": (cluster_attention, MASKS),
}


# ----------------------------------------------------------------- worker


def versions() -> dict[str, str]:
    import numpy

    return {"torch": torch.__version__, "numpy": numpy.__version__}


def start_peak() -> None:
    """Forgets the peak memory so far, as `clift bench` does: what is reported is that of the timed repetitions."""
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def measure(work: Work, repeats: int, warmup: int, finish: Callable[[], None] = lambda: None) -> list[float]:
    """Seconds of every repetition; `finish` waits for a device that queues its work."""
    for _ in range(warmup):
        work()
    finish()
    start_peak()
    samples = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        finish()
        samples.append(time.perf_counter() - start)
    return samples


def autocast(kind: str, precision: str) -> contextlib.AbstractContextManager[Any]:
    """bf16 autocast where the precision is `bf16`. Rays stay f32, as ours do."""
    twin.plucker = torch.autocast(kind, enabled=False)(twin.plucker)
    return torch.autocast(kind, dtype=torch.bfloat16, enabled=precision == "bf16")


def compile_if(variant: str, *modules: nn.Module) -> None:
    """Compiles the modules for variants that begin so."""
    if variant.startswith(COMPILED):
        for module in modules:
            module.compile()


def on_device(spec: dict[str, Any]) -> dict[str, Any]:
    """A work on a device: `cuda`, `mps` or `cpu`, in `f32`, `tf32` (f32 with TF32 products) or `bf16` (autocast).

    The whole step runs under autocast, its backward too: gradients have the types of their forward either way.
    """
    device, precision = spec["device"], spec["precision"]
    torch.set_default_device(device)
    torch.set_float32_matmul_precision("high" if precision == "tf32" else "highest")
    is_cuda = device.startswith("cuda")
    finish = torch.cuda.synchronize if is_cuda else torch.mps.synchronize if device == "mps" else lambda: None
    kind = device.split(":")[0]
    make, _ = WORKS[spec["work"]]
    with autocast(kind, precision):
        work = make(spec["size"], spec["variant"])
        samples = measure(work, spec["repeats"], spec["warmup"], finish)
    peak = torch.cuda.max_memory_allocated() if is_cuda else None
    return {"samples_s": samples, "device_bytes": peak}


def adapter(device: str) -> str:
    """What a device calls itself."""
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else device


def main() -> None:
    spec = json.loads(sys.argv[1])
    torch.set_num_threads(spec["threads"])
    torch.manual_seed(0)
    if spec["work"] == "import":
        result = {}
    elif spec["work"] == "where":
        found = "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"
        device = spec["device"] or found
        result = {"device": device, "adapter": adapter(device), "torch": torch.__version__}
    elif "device" in spec:
        result = on_device(spec)
    elif spec["work"] == "versions":
        variants = {name: variants for name, (_, variants) in WORKS.items()}
        result = {"versions": versions(), "variants": variants}
    else:
        make, _ = WORKS[spec["work"]]
        with autocast("cpu", spec["precision"]):
            samples = measure(make(spec["size"], spec["variant"]), spec["repeats"], spec["warmup"])
        per_view = NUM_VIEWS_OF_SCENE if spec["work"].startswith("render_8_views") else 1
        result = {"samples_s": [sample / per_view for sample in samples]}
    print(json.dumps(result))


if __name__ == "__main__":
    main()
