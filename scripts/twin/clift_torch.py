"""The PyTorch twin of clift: the paper's model in plain torch.nn.

Written from the paper's equations, independently of the Rust code, so that
agreement between the two means something. Three things use it: the parity
fixtures (make_fixtures.py), speed comparisons, and moving weights between the
two frameworks (`export_state`, `load_state`).

It is written to be read and to be right, not to be fast: the condenser uses a
dense `[S, N]` mask, which is what checks the Rust segment softmax.

Letters in shape comments:
  B scenes, V context views, T target views, H W image size in pixels,
  h w = H/8, W/8 patches, N = V*h*w encoder tokens, S stored tokens,
  R tokens given to the renderer, Q = h*w patches of one target, D width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn as nn
import torch.nn.functional as F
from torch import Tensor

PATCH_SIZE = 8
COLOR_CHANNELS = 3
RAY_CHANNELS = 6
CONTEXT_PATCH_DIM = PATCH_SIZE**2 * (COLOR_CHANNELS + RAY_CHANNELS)  # 576
RAY_PATCH_DIM = PATCH_SIZE**2 * RAY_CHANNELS  # 384
PIXEL_PATCH_DIM = PATCH_SIZE**2 * COLOR_CHANNELS  # 192


# ------------------------------------------------------------------ rays


def plucker(intrinsics: Tensor, c2w: Tensor, height: int, width: int) -> Tensor:
    """Computes the Plücker ray `[moment, direction]` of every pixel.

    `intrinsics` is `[B, V, 4]` = (fx, fy, cx, cy) in pixels, `c2w` is
    `[B, V, 4, 4]` in OpenCV axes (+x right, +y down, +z forward).
    Pixel centres lie at +0.5. The direction is normalised in the camera frame
    and then rotated; the moment is `origin x direction`.
    Returns `[B, V, H, W, 6]`.
    """
    like = dict(dtype=intrinsics.dtype, device=intrinsics.device)
    v, u = torch.meshgrid(
        torch.arange(height, **like) + 0.5,
        torch.arange(width, **like) + 0.5,
        indexing="ij",
    )  # [H, W]
    fx, fy, cx, cy = intrinsics[:, :, None, None, :].unbind(-1)  # [B, V, 1, 1]
    x = (u - cx) / fx
    y = (v - cy) / fy
    direction = F.normalize(torch.stack([x, y, torch.ones_like(x)], -1), dim=-1)
    direction = torch.einsum("bvij,bvhwj->bvhwi", c2w[..., :3, :3], direction)
    origin = c2w[..., :3, 3][:, :, None, None, :].expand_as(direction)
    moment = torch.linalg.cross(origin, direction, dim=-1)
    return torch.cat([moment, direction], -1)


# --------------------------------------------------------------- patches


def patchify(pixels: Tensor) -> Tensor:
    """Cuts `[B, V, H, W, C]` into `[B, V*h*w, 64*C]`.

    Token id is `v*(h*w) + y*w + x`; the index inside a patch vector is
    `(p1*8 + p2)*C + c`, where p1 counts rows and p2 columns.
    """
    batch, views, height, width, channels = pixels.shape
    p = PATCH_SIZE
    if height % p or width % p:
        raise ValueError(f"image size must be a multiple of {p}: got {height}x{width}")
    patches = pixels.reshape(batch, views, height // p, p, width // p, p, channels)
    patches = patches.permute(0, 1, 2, 4, 3, 5, 6)  # [B, V, h, w, p1, p2, C]
    return patches.reshape(batch, views * (height // p) * (width // p), p * p * channels)


def unpatchify(patches: Tensor, height: int, width: int) -> Tensor:
    """Undoes `patchify`: `[B, V*h*w, 64*C]` to `[B, V, H, W, C]`."""
    p = PATCH_SIZE
    batch, tokens, size = patches.shape
    rows, columns, channels = height // p, width // p, size // (p * p)
    views = tokens // (rows * columns)
    pixels = patches.reshape(batch, views, rows, columns, p, p, channels)
    pixels = pixels.permute(0, 1, 2, 4, 3, 5, 6)  # [B, V, h, p1, w, p2, C]
    return pixels.reshape(batch, views, height, width, channels)


def context_patches(images: Tensor, rays: Tensor) -> Tensor:
    """Joins colour and ray per pixel, [R, G, B, m, d], and patchifies: `[B, N, 576]`."""
    return patchify(torch.cat([images, rays], -1))


# ---------------------------------------------------------------- blocks


def encoder_block(dim: int, num_heads: int, feed_forward_dim: int) -> nn.TransformerEncoderLayer:
    """A pre-norm self-attention block: exact GELU, no dropout, biases everywhere."""
    return nn.TransformerEncoderLayer(
        dim, num_heads, feed_forward_dim, dropout=0.0, activation=F.gelu, batch_first=True, norm_first=True
    )


def decoder_block(dim: int, num_heads: int, feed_forward_dim: int) -> nn.TransformerDecoderLayer:
    """A pre-norm decoder block. The memory is not normalised, only the query is."""
    return nn.TransformerDecoderLayer(
        dim, num_heads, feed_forward_dim, dropout=0.0, activation=F.gelu, batch_first=True, norm_first=True
    )


class FeedForward(nn.Module):
    """Linear up, exact GELU, Linear down."""

    def __init__(self, dim: int, hidden_dim: int):
        super().__init__()
        self.up = nn.Linear(dim, hidden_dim)
        self.down = nn.Linear(hidden_dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.down(F.gelu(self.up(x)))


# ------------------------------------------------ camera-relative attention


def token_matrices(intrinsics: Tensor, c2w: Tensor, height: int, width: int, head_dim: int) -> Tensor:
    """The matrix `rho` of every patch as a dense matrix, `[B, V*h*w, E, E]` (GTA).

    Channel `j*E/8 + k` of a head is coordinate j of the k-th 4-vector, on which the
    world-to-camera matrix acts. Channels `E/2 + p` and `3E/4 + p`
    are a pair that turns by the angle p: E/8 of them by the row, E/8 by the column of
    the patch's centre, in patches from the principal point.
    """
    rows, columns, count = height // PATCH_SIZE, width // PATCH_SIZE, head_dim // 8
    batch, views = c2w.shape[:2]
    g = torch.linalg.inv(c2w)
    rho = torch.zeros(batch, views, rows, columns, head_dim, head_dim, dtype=c2w.dtype)
    for i in range(4):
        for j in range(4):
            for k in range(count):
                rho[..., i * count + k, j * count + k] = g[:, :, None, None, i, j]
    for row in range(rows):
        for column in range(columns):
            for p in range(2 * count):
                centre, axis, index = (row + 0.5, 3, p) if p < count else (column + 0.5, 2, p - count)
                angle = (centre - intrinsics[..., axis] / PATCH_SIZE) * 100.0 ** (-index / count)
                a, b = 4 * count + p, 6 * count + p
                rho[:, :, row, column, a, a] = rho[:, :, row, column, b, b] = angle.cos()
                rho[:, :, row, column, a, b] = -angle.sin()
                rho[:, :, row, column, b, a] = angle.sin()
    return rho.flatten(1, 3)


def camera_attention(q: Tensor, k: Tensor, v: Tensor, rho_q: Tensor, rho_k: Tensor, num_heads: int) -> Tensor:
    """Attention of `[B, M, D]` to `[B, N, D]` in the frames of the cameras: the score of a pair is
    `q^T rho_q rho_k^-1 k`, and its value `rho_q rho_k^-1 v`."""
    q, k, v = (x.unflatten(-1, (num_heads, -1)) for x in (q, k, v))  # [B, N, H, E]
    relative = torch.einsum("bmij,bnjk->bmnik", rho_q, torch.linalg.inv(rho_k))  # [B, M, N, E, E]
    scores = torch.einsum("bmhi,bmnij,bnhj->bhmn", q, relative, k) / math.sqrt(q.shape[-1])
    return torch.einsum("bhmn,bmnij,bnhj->bmhi", scores.softmax(-1), relative, v).flatten(-2)


# --------------------------------------------------------------- encoder


class Encoder(nn.Module):
    """Turns posed images into LiFT tokens. No norm after the last block."""

    def __init__(self, dim: int, num_heads: int, num_blocks: int, feed_forward_dim: int):
        super().__init__()
        self.patch_embed = nn.Linear(CONTEXT_PATCH_DIM, dim)
        self.blocks = nn.ModuleList(encoder_block(dim, num_heads, feed_forward_dim) for _ in range(num_blocks))

    def forward(self, images: Tensor, rays: Tensor) -> Tensor:
        """`images` `[B, V, H, W, 3]` in [0, 1], `rays` `[B, V, H, W, 6]`; returns `[B, N, D]`."""
        tokens = self.patch_embed(context_patches(images, rays))
        for block in self.blocks:
            tokens = block(tokens)
        return tokens


# -------------------------------------------------------------- renderer


class Renderer(nn.Module):
    """Renders target views from tokens; every target view is decoded on its own."""

    def __init__(self, dim: int, num_heads: int, num_blocks: int, feed_forward_dim: int):
        super().__init__()
        self.ray_embed = nn.Linear(RAY_PATCH_DIM, dim)
        self.blocks = nn.ModuleList(decoder_block(dim, num_heads, feed_forward_dim) for _ in range(num_blocks))
        self.output_norm = nn.LayerNorm(dim)
        self.to_pixels = nn.Linear(dim, PIXEL_PATCH_DIM)

    def forward(self, memory: Tensor, rays: Tensor) -> Tensor:
        """Renders `rays` `[B, T, H, W, 6]`; returns `[B, T, H, W, 3]` in (0, 1).

        `memory` is `[B, R, D]`, shared by the targets of a scene, or
        `[B, T, R, D]`, one token set per target.
        """
        batch, targets, height, width, _ = rays.shape
        if memory.dim() == 3:
            memory = memory[:, None].expand(-1, targets, -1, -1)
        memory = memory.flatten(0, 1)  # [B*T, R, D]
        # One target view per batch entry, so self-attention never crosses views.
        query = self.ray_embed(patchify(rays.flatten(0, 1)[:, None]))  # [B*T, Q, D]
        for block in self.blocks:
            query = block(query, memory)
        patches = torch.sigmoid(self.to_pixels(self.output_norm(query)))
        return unpatchify(patches, height, width).reshape(batch, targets, height, width, COLOR_CHANNELS)


# ------------------------------------------------------------- condenser


class ClusterAttention(nn.Module):
    """Attention of each centroid over the other tokens of its cluster (equation 2)."""

    def __init__(self, dim: int, num_heads: int):
        super().__init__()
        self.num_heads = num_heads
        self.q_proj = nn.Linear(dim, dim)
        self.kv_proj = nn.Linear(dim, 2 * dim)
        self.out_proj = nn.Linear(dim, dim)

    def forward(self, query: Tensor, memory: Tensor, mask: Tensor) -> Tensor:
        """`query` `[B, S, D]`, `memory` `[B, N, D]`, `mask` `[B, S, N]` true where a key is seen.

        A query without any key gets exactly zero, not the output bias.
        """
        batch, num_queries, dim = query.shape
        heads, head_dim = self.num_heads, dim // self.num_heads
        q = self.q_proj(query).reshape(batch, num_queries, heads, head_dim)
        k, v = (t.reshape(batch, -1, heads, head_dim) for t in self.kv_proj(memory).chunk(2, -1))
        scores = torch.einsum("bshd,bnhd->bhsn", q, k) / math.sqrt(head_dim)
        has_key = mask.any(-1)  # [B, S]
        # A row without keys is left unmasked, so that its softmax and gradient
        # stay finite; the `where` below drops it.
        seen = mask | ~has_key[..., None]
        weights = scores.masked_fill(~seen[:, None], -math.inf).softmax(-1)
        mixed = torch.einsum("bhsn,bnhd->bshd", weights, v).reshape(batch, num_queries, dim)
        return torch.where(has_key[..., None], self.out_proj(mixed), torch.zeros_like(query))


class CondenserBlock(nn.Module):
    """One pass of the paper's equations 1-4.

    `residual=False` follows the equations as printed: no residual inside the
    block, and a centroid that is alone in its cluster keeps equation 1's value.
    `residual=True` adds a residual around each of the three layers, and a norm
    before the cluster attention's query. `member_share=True` multiplies what
    equation 4 adds by the share of keys among the tokens of a cluster.
    """

    def __init__(self, dim: int, num_heads: int, feed_forward_dim: int, residual: bool, member_share: bool):
        super().__init__()
        self.residual, self.member_share = residual, member_share
        self.norm_self = nn.LayerNorm(dim)
        self.self_attn = nn.MultiheadAttention(dim, num_heads, batch_first=True)
        if residual:
            self.norm_cross = nn.LayerNorm(dim)
        self.norm_memory = nn.LayerNorm(dim)
        self.cluster_attn = ClusterAttention(dim, num_heads)
        self.norm_ff = nn.LayerNorm(dim)
        self.feed_forward = FeedForward(dim, feed_forward_dim)
        self.gate = nn.Linear(dim, dim, bias=False)
        nn.init.zeros_(self.gate.weight)

    def forward(self, centroids: Tensor, lift: Tensor, mask: Tensor) -> Tensor:
        """`centroids` `[B, S, D]`, `lift` `[B, N, D]`, `mask` `[B, S, N]`; returns `[B, S, D]`."""
        normed = self.norm_self(centroids)
        x, _ = self.self_attn(normed, normed, normed, need_weights=False)  # equation 1
        memory = self.norm_memory(lift)
        if self.residual:
            x = centroids + x
            y = x + self.cluster_attn(self.norm_cross(x), memory, mask)  # equation 2
            z = y + self.feed_forward(self.norm_ff(y))  # equation 3
        else:
            gathered = self.cluster_attn(x, memory, mask)  # equation 2
            y = torch.where(mask.any(-1, keepdim=True), gathered, x)
            z = self.feed_forward(self.norm_ff(y))  # equation 3
        count = mask.sum(-1, keepdim=True).to(z.dtype)
        share = count / (count + 1) if self.member_share else 1
        return centroids + share * self.gate(z)  # equation 4


def cluster_mask(assignment: Tensor, centroid_index: Tensor) -> Tensor:
    """Says which tokens are keys of which centroid: `[B, N]`, `[B, S]` to bool `[B, S, N]`.

    The keys of centroid k are the tokens of cluster k except the centroid itself.
    """
    num_tokens, num_clusters = assignment.shape[1], centroid_index.shape[1]
    cluster = torch.arange(num_clusters, device=assignment.device)
    token = torch.arange(num_tokens, device=assignment.device)
    member = assignment[:, None, :] == cluster[None, :, None]
    is_centroid = token[None, None, :] == centroid_index[:, :, None]
    return member & ~is_centroid


class Condenser(nn.Module):
    """Writes what each cluster knows into its centroid (variant `paper`)."""

    def __init__(
        self,
        dim: int,
        num_heads: int,
        num_blocks: int,
        feed_forward_dim: int,
        residual: bool,
        member_share: bool = False,
    ):
        super().__init__()
        self.blocks = nn.ModuleList(
            CondenserBlock(dim, num_heads, feed_forward_dim, residual, member_share) for _ in range(num_blocks)
        )

    def forward(self, lift: Tensor, assignment: Tensor, centroid_index: Tensor) -> Tensor:
        """`lift` `[B, N, D]`, `assignment` `[B, N]`, `centroid_index` `[B, S]`; returns `[B, S, D]`.

        The keys and values are the original tokens in every block.
        """
        centroids = lift.gather(1, centroid_index[..., None].expand(-1, -1, lift.shape[-1]))
        mask = cluster_mask(assignment, centroid_index)
        for block in self.blocks:
            centroids = block(centroids, lift, mask)
        return centroids


# ----------------------------------------------------------------- model


@dataclass
class ModelConfig:
    """Sizes of the network; the defaults are the paper's, with the released feed-forward width."""

    dim: int = 768
    num_heads: int = 8
    feed_forward_dim: int = 2048
    num_encoder_blocks: int = 6
    num_renderer_blocks: int = 6
    num_condenser_blocks: int = 2
    condenser_residual: bool = False


class Clift(nn.Module):
    """Encoder and renderer (stage 1); with `condenser=True` the condenser too (stage 2)."""

    def __init__(self, config: ModelConfig, condenser: bool = False):
        super().__init__()
        c = config
        self.encoder = Encoder(c.dim, c.num_heads, c.num_encoder_blocks, c.feed_forward_dim)
        self.renderer = Renderer(c.dim, c.num_heads, c.num_renderer_blocks, c.feed_forward_dim)
        self.condenser = (
            Condenser(c.dim, c.num_heads, c.num_condenser_blocks, c.feed_forward_dim, c.condenser_residual)
            if condenser
            else None
        )

    def encode(self, images: Tensor, intrinsics: Tensor, c2w: Tensor) -> Tensor:
        """Posed context images `[B, V, H, W, 3]` to LiFT tokens `[B, N, D]`."""
        height, width = images.shape[2:4]
        return self.encoder(images, plucker(intrinsics, c2w, height, width))

    def render(self, memory: Tensor, intrinsics: Tensor, c2w: Tensor, height: int, width: int) -> Tensor:
        """Tokens and target cameras `[B, T, ..]` to pictures `[B, T, H, W, 3]`."""
        return self.renderer(memory, plucker(intrinsics, c2w, height, width))


# -------------------------------------------------------------- training


@dataclass
class Batch:
    """One training batch: context and target images `[B, V|T, H, W, 3]` with their cameras."""

    context_images: Tensor
    context_intrinsics: Tensor
    context_c2w: Tensor
    target_images: Tensor
    target_intrinsics: Tensor
    target_c2w: Tensor


def drop_tokens(
    lift: Tensor, num_targets: int, num_render_tokens: int, generator: torch.Generator | None = None
) -> Tensor:
    """Draws an independent random token subset per (scene, target): `[B, T, R, D]`."""
    batch, num_tokens, dim = lift.shape
    draw = torch.rand(batch, num_targets, num_tokens, device=lift.device, generator=generator)
    kept = draw.argsort(-1)[..., :num_render_tokens]  # [B, T, R]
    tokens = lift[:, None].expand(-1, num_targets, -1, -1)
    return tokens.gather(2, kept[..., None].expand(-1, -1, -1, dim))


def stage1_loss(
    model: Clift, batch: Batch, num_render_tokens: int | None = None, generator: torch.Generator | None = None
) -> Tensor:
    """Encodes, drops tokens if asked, renders, and returns the mean squared error."""
    lift = model.encode(batch.context_images, batch.context_intrinsics, batch.context_c2w)
    _, targets, height, width, _ = batch.target_images.shape
    memory = lift
    if num_render_tokens is not None and num_render_tokens < lift.shape[1]:
        memory = drop_tokens(lift, targets, num_render_tokens, generator)
    rendering = model.render(memory, batch.target_intrinsics, batch.target_c2w, height, width)
    return F.mse_loss(rendering, batch.target_images)


def adamw(model: nn.Module, lr: float) -> torch.optim.AdamW:
    """AdamW as in training: weight decay on every parameter, biases and norms too."""
    return torch.optim.AdamW(model.parameters(), lr=lr, betas=(0.9, 0.95), eps=1e-8, weight_decay=0.05)


def learning_rate(step: int, base: float, warmup_steps: int, total_steps: int) -> float:
    """The rate of `step` = 1, 2, ..: linear warm-up from 1e-8, then a cosine that ends at 0."""
    start = 1e-8
    if step <= warmup_steps:
        return start + (base - start) * step / warmup_steps
    progress = (step - warmup_steps) / (total_steps - warmup_steps)
    return base * 0.5 * (1.0 + math.cos(math.pi * progress))


def stage1_step(
    model: Clift,
    optimizer: torch.optim.Optimizer,
    batch: Batch,
    num_render_tokens: int | None = None,
    max_grad_norm: float = 1.0,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Makes one stage-1 update (MSE only); returns the loss and the gradient norm before clipping.

    Neither is read back to the host, so a benchmark decides when to synchronise.
    """
    optimizer.zero_grad(set_to_none=True)
    loss = stage1_loss(model, batch, num_render_tokens, generator)
    loss.backward()
    grad_norm = nn.utils.clip_grad_norm_(model.parameters(), max_grad_norm)
    optimizer.step()
    return loss.detach(), grad_norm


# --------------------------------------------------------------- weights


def rust_parameters(module: nn.Module, prefix: str = "") -> dict[str, tuple[nn.Parameter, slice]]:
    """Maps every path of the Rust module to a torch parameter and the rows of it that it holds.

    The rows matter once: a decoder block's packed cross-attention projection
    `[3D, D]` is `q_proj` `[D, D]` and `kv_proj` `[2D, D]` in Rust.
    """
    found: dict[str, tuple[nn.Parameter, slice]] = {}

    def leaf(path: str, layer: nn.Module) -> None:
        found[f"{prefix}{path}.weight"] = (layer.weight, slice(None))
        if getattr(layer, "bias", None) is not None:
            found[f"{prefix}{path}.bias"] = (layer.bias, slice(None))

    def rows(path: str, weight: nn.Parameter, bias: nn.Parameter, part: slice) -> None:
        found[f"{prefix}{path}.weight"] = (weight, part)
        found[f"{prefix}{path}.bias"] = (bias, part)

    def self_attention(path: str, attn: nn.MultiheadAttention) -> None:
        rows(f"{path}.in_proj", attn.in_proj_weight, attn.in_proj_bias, slice(None))
        leaf(f"{path}.out_proj", attn.out_proj)

    def children(**modules: nn.Module) -> None:
        for name, child in modules.items():
            found.update(rust_parameters(child, f"{prefix}{name}."))

    if hasattr(module, "rust_layers"):
        # The modules of another twin name their layers themselves.
        for name, layer in module.rust_layers().items():
            if isinstance(layer, nn.ModuleList):
                children(**{name: layer})
            else:
                leaf(name, layer)
    elif isinstance(module, Clift):
        parts = dict(encoder=module.encoder, condenser=module.condenser, renderer=module.renderer)
        children(**{name: part for name, part in parts.items() if part is not None})
    elif isinstance(module, nn.ModuleList):
        children(**{str(i): block for i, block in enumerate(module)})
    elif isinstance(module, Encoder):
        leaf("patch_embed", module.patch_embed)
        children(blocks=module.blocks)
    elif isinstance(module, Renderer):
        leaf("ray_embed", module.ray_embed)
        children(blocks=module.blocks)
        leaf("output_norm", module.output_norm)
        leaf("to_pixels", module.to_pixels)
    elif isinstance(module, Condenser):
        children(blocks=module.blocks)
    elif isinstance(module, nn.TransformerEncoderLayer):
        leaf("norm_attn", module.norm1)
        self_attention("attn", module.self_attn)
        leaf("norm_ff", module.norm2)
        leaf("feed_forward.up", module.linear1)
        leaf("feed_forward.down", module.linear2)
    elif isinstance(module, nn.TransformerDecoderLayer):
        leaf("norm_self", module.norm1)
        self_attention("self_attn", module.self_attn)
        leaf("norm_cross", module.norm2)
        cross, dim = module.multihead_attn, module.multihead_attn.embed_dim
        rows("cross_attn.q_proj", cross.in_proj_weight, cross.in_proj_bias, slice(0, dim))
        rows("cross_attn.kv_proj", cross.in_proj_weight, cross.in_proj_bias, slice(dim, 3 * dim))
        leaf("cross_attn.out_proj", cross.out_proj)
        leaf("norm_ff", module.norm3)
        leaf("feed_forward.up", module.linear1)
        leaf("feed_forward.down", module.linear2)
    elif isinstance(module, CondenserBlock):
        leaf("norm_self", module.norm_self)
        self_attention("self_attn", module.self_attn)
        if module.residual:
            leaf("norm_cross", module.norm_cross)
        leaf("norm_memory", module.norm_memory)
        leaf("cluster_attn.q_proj", module.cluster_attn.q_proj)
        leaf("cluster_attn.kv_proj", module.cluster_attn.kv_proj)
        leaf("cluster_attn.out_proj", module.cluster_attn.out_proj)
        leaf("norm_ff", module.norm_ff)
        leaf("feed_forward.up", module.feed_forward.up)
        leaf("feed_forward.down", module.feed_forward.down)
        leaf("gate", module.gate)
    else:
        raise TypeError(f"no Rust counterpart for {type(module).__name__}")
    return found


def export_state(module: nn.Module) -> dict[str, Tensor]:
    """Copies the weights under the Rust module's paths.

    Linear weights stay in PyTorch's layout `[out, in]`; LayerNorm is `weight`, `bias`.
    """
    return {path: p.detach()[part].clone() for path, (p, part) in rust_parameters(module).items()}


def export_gradients(module: nn.Module) -> dict[str, Tensor]:
    """Copies the gradients under the same paths as `export_state`."""
    return {path: p.grad[part].clone() for path, (p, part) in rust_parameters(module).items()}


def load_state(module: nn.Module, state: dict[str, Tensor]) -> None:
    """Loads what `export_state` wrote; the set of paths must match exactly."""
    slots = rust_parameters(module)
    if slots.keys() != state.keys():
        raise KeyError(
            f"paths differ: missing {sorted(slots.keys() - state.keys())}, "
            f"unexpected {sorted(state.keys() - slots.keys())}"
        )
    with torch.no_grad():
        for path, (parameter, part) in slots.items():
            target = parameter[part]
            if target.shape != state[path].shape:
                raise ValueError(f"{path}: expected {tuple(target.shape)}, got {tuple(state[path].shape)}")
            target.copy_(state[path])
