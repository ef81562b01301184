"""The published networks in plain torch: the part of the PyTorch twin that stands for the released checkpoints.

Written from docs/guide/checkpoints.md, independently of the Rust code and without the
released code. Modules carry the names that the checkpoints' keys have below
`transformer.`, so that `state_dict` and a strict `load_state_dict` are the test:

    linear_input, encoder.layers.N, [input_norm], linear_target, decoder.layers.N,
    output_norm, patch_to_image.0, squeezer.{cross_attn, linear1}

Variants: `released-re10k`, `released-dl3dv` (adds `input_norm` and the q_norm, k_norm
of every attention in encoder and decoder; the squeezer has none), and `paper`, whose condenser is clift_torch's, below `squeezer.blocks`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn as nn
import torch.nn.functional as F
from torch import Tensor

import clift_torch as twin

VARIANTS = ("paper", "released-re10k", "released-dl3dv")
PREFIX = "transformer."


@dataclass
class ReleasedConfig:
    """Sizes; the defaults are the published ones."""

    variant: str = "released-re10k"
    dim: int = 768
    num_heads: int = 8
    feed_forward_dim: int = 2048
    num_encoder_blocks: int = 6
    num_renderer_blocks: int = 6
    num_condenser_blocks: int = 2  # of the variant `paper`
    condenser_residual: bool = True  # of the variant `paper`
    condenser: bool = True
    # Which of the projections are 1x1 convolutions: all in the published module.
    convolutions: tuple[str, ...] = ("linear_input", "linear_target", "patch_to_image.0")

    @property
    def has_norms(self) -> bool:
        return self.variant == "released-dl3dv"


class RmsNorm(nn.Module):
    """`x / sqrt(mean(x^2) + 1e-5) * weight` over the last dimension."""

    def __init__(self, size: int):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(size))

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.rsqrt(x.square().mean(-1, keepdim=True) + 1e-5) * self.weight


class NormedAttention(nn.Module):
    """Multi-head attention with the names of nn.MultiheadAttention, and an RMS norm of every head's q and k."""

    def __init__(self, dim: int, num_heads: int):
        super().__init__()
        self.num_heads = num_heads
        self.in_proj_weight = nn.Parameter(torch.empty(3 * dim, dim))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * dim))
        self.out_proj = nn.Linear(dim, dim)
        self.q_norm = RmsNorm(dim // num_heads)
        self.k_norm = RmsNorm(dim // num_heads)
        nn.init.xavier_uniform_(self.in_proj_weight)

    def forward(self, query: Tensor, memory: Tensor, hidden: Tensor | None) -> Tensor:
        """`query` `[B, Q, D]`, `memory` `[B, K, D]`, `hidden` `[B, Q, K]` true where a key is not seen."""
        (wq, wk, wv), (bq, bk, bv) = self.in_proj_weight.chunk(3), self.in_proj_bias.chunk(3)

        def heads(x: Tensor) -> Tensor:
            return x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)  # [B, H, N, E]

        q = self.q_norm(heads(F.linear(query, wq, bq)))
        k = self.k_norm(heads(F.linear(memory, wk, bk)))
        v = heads(F.linear(memory, wv, bv))
        scores = q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5
        if hidden is not None:
            scores = scores.masked_fill(hidden[:, None], float("-inf"))
        return self.out_proj((scores.softmax(-1) @ v).transpose(1, 2).flatten(2))


class PlainAttention(nn.MultiheadAttention):
    """nn.MultiheadAttention with the call of NormedAttention."""

    def __init__(self, dim: int, num_heads: int):
        super().__init__(dim, num_heads, batch_first=True)

    def forward(self, query: Tensor, memory: Tensor, hidden: Tensor | None) -> Tensor:  # type: ignore[override]
        mask = None if hidden is None else hidden.repeat_interleave(self.num_heads, 0)
        return super().forward(query, memory, memory, attn_mask=mask, need_weights=False)[0]


def attention(c: ReleasedConfig) -> nn.Module:
    return (NormedAttention if c.has_norms else PlainAttention)(c.dim, c.num_heads)


class EncoderLayer(nn.Module):
    """A pre-norm layer with GELU, named as nn.TransformerEncoderLayer."""

    def __init__(self, c: ReleasedConfig):
        super().__init__()
        self.self_attn = attention(c)
        self.linear1 = nn.Linear(c.dim, c.feed_forward_dim)
        self.linear2 = nn.Linear(c.feed_forward_dim, c.dim)
        self.norm1 = nn.LayerNorm(c.dim)
        self.norm2 = nn.LayerNorm(c.dim)

    def forward(self, x: Tensor) -> Tensor:
        normed = self.norm1(x)
        x = x + self.self_attn(normed, normed, None)
        return x + self.linear2(F.gelu(self.linear1(self.norm2(x))))


class DecoderLayer(nn.Module):
    """A pre-norm layer named as nn.TransformerDecoderLayer; the memory is taken as it is."""

    def __init__(self, c: ReleasedConfig, activation=F.gelu, attention=attention):
        super().__init__()
        self.self_attn = attention(c)
        self.multihead_attn = attention(c)
        self.linear1 = nn.Linear(c.dim, c.feed_forward_dim)
        self.linear2 = nn.Linear(c.feed_forward_dim, c.dim)
        self.norm1 = nn.LayerNorm(c.dim)
        self.norm2 = nn.LayerNorm(c.dim)
        self.norm3 = nn.LayerNorm(c.dim)
        self.activation = activation

    def forward(self, x: Tensor, memory: Tensor, hidden: Tensor | None = None) -> Tensor:
        normed = self.norm1(x)
        x = x + self.self_attn(normed, normed, None)
        x = x + self.multihead_attn(self.norm2(x), memory, hidden)
        return x + self.linear2(self.activation(self.linear1(self.norm3(x))))


class Layers(nn.Module):
    """What only gives its layers the name `layers`."""

    def __init__(self, layers):
        super().__init__()
        self.layers = nn.ModuleList(layers)


class Squeezer(nn.Module):
    """The condenser: one decoder layer with ReLU over the tokens of the same cluster, and a gate with bias."""

    def __init__(self, c: ReleasedConfig):
        super().__init__()
        self.cross_attn = DecoderLayer(c, F.relu, lambda c: PlainAttention(c.dim, c.num_heads))
        self.linear1 = nn.Linear(c.dim, c.dim)
        nn.init.zeros_(self.linear1.weight)
        nn.init.zeros_(self.linear1.bias)

    def forward(self, lift: Tensor, assignment: Tensor, centroid_index: Tensor) -> Tensor:
        centroids = lift.gather(1, centroid_index[..., None].expand(-1, -1, lift.shape[-1]))
        cluster = torch.arange(centroid_index.shape[1])
        hidden = assignment[:, None, :] != cluster[None, :, None]  # [B, S, N]; a centroid sees itself
        return centroids + self.linear1(self.cross_attn(centroids, lift, hidden))


def projection(c: ReleasedConfig, name: str, inputs: int, outputs: int) -> nn.Module:
    return nn.Conv2d(inputs, outputs, 1) if name in c.convolutions else nn.Linear(inputs, outputs)


def apply(layer: nn.Module, x: Tensor) -> Tensor:
    """A projection of `[B, N, inputs]`, whichever of the two it is."""
    if isinstance(layer, nn.Conv2d):
        return layer(x.transpose(1, 2)[..., None])[..., 0].transpose(1, 2)
    return layer(x)


class ReleasedClift(nn.Module):
    """The network of a published checkpoint."""

    def __init__(self, config: ReleasedConfig):
        super().__init__()
        c = self.config = config
        self.linear_input = projection(c, "linear_input", twin.CONTEXT_PATCH_DIM, c.dim)
        self.linear_target = projection(c, "linear_target", twin.RAY_PATCH_DIM, c.dim)
        self.encoder = Layers(EncoderLayer(c) for _ in range(c.num_encoder_blocks))
        self.decoder = Layers(DecoderLayer(c) for _ in range(c.num_renderer_blocks))
        self.input_norm = nn.LayerNorm(c.dim) if c.has_norms else None
        self.output_norm = nn.LayerNorm(c.dim)
        self.patch_to_image = nn.Sequential(
            projection(c, "patch_to_image.0", c.dim, twin.PIXEL_PATCH_DIM), nn.Sigmoid()
        )
        self.squeezer = None
        if c.condenser and c.variant == "paper":
            self.squeezer = twin.Condenser(
                c.dim, c.num_heads, c.num_condenser_blocks, c.feed_forward_dim, c.condenser_residual
            )
        elif c.condenser:
            self.squeezer = Squeezer(c)

    def encode(self, images: Tensor, intrinsics: Tensor, c2w: Tensor) -> Tensor:
        """Posed context images `[B, V, H, W, 3]` to encoder features `[B, N, D]`, before any norm."""
        height, width = images.shape[2:4]
        x = apply(self.linear_input, twin.context_patches(images, twin.plucker(intrinsics, c2w, height, width)))
        for layer in self.encoder.layers:
            x = layer(x)
        return x

    def lift(self, features: Tensor) -> Tensor:
        """What condenser and renderer read."""
        return features if self.input_norm is None else self.input_norm(features)

    def condense(self, lift: Tensor, assignment: Tensor, centroid_index: Tensor) -> Tensor:
        return self.squeezer(lift, assignment, centroid_index)

    def render(self, tokens: Tensor, intrinsics: Tensor, c2w: Tensor, height: int, width: int) -> Tensor:
        """Tokens `[B, R, D]` and cameras `[B, T, ..]` to pictures `[B, T, H, W, 3]`."""
        pictures = []
        for view in range(c2w.shape[1]):
            rays = twin.plucker(intrinsics[:, view : view + 1], c2w[:, view : view + 1], height, width)
            x = apply(self.linear_target, twin.patchify(rays))
            for layer in self.decoder.layers:
                x = layer(x, tokens)
            last = self.patch_to_image
            patches = last[1](apply(last[0], self.output_norm(x)))
            pictures.append(twin.unpatchify(patches, height, width))
        return torch.cat(pictures, 1)
