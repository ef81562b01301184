"""The PyTorch twin of LVSM's encoder-decoder, the baseline of the paper's main figure, in plain torch.nn.

Written from the equations of LVSM's paper (arXiv 2410.17242), independently of the
Rust code. `Lvsm` has the interface of `clift_torch.Clift`: `encode`, `render`, and
`clift_torch.rust_parameters` maps its weights.

Letters in shape comments: as in clift_torch, and L latents.
"""

from __future__ import annotations

from dataclasses import dataclass

import clift_torch as twin
import torch
import torch.nn as nn
import torch.nn.functional as F
from torch import Tensor


@dataclass
class LvsmConfig:
    """Sizes of the network; the defaults are LVSM's, with the six blocks each of the CLiFT paper."""

    dim: int = 768
    num_heads: int = 12
    feed_forward_dim: int = 3072
    num_encoder_blocks: int = 6
    num_renderer_blocks: int = 6
    num_latents: int = 3072


class Block(nn.Module):
    """A pre-norm self-attention block without biases, with RMS norms of queries and keys."""

    def __init__(self, dim: int, num_heads: int, feed_forward_dim: int):
        super().__init__()
        self.num_heads = num_heads
        self.norm_attn = nn.LayerNorm(dim, bias=False)
        self.in_proj = nn.Linear(dim, 3 * dim, bias=False)
        self.query_norm = nn.RMSNorm(dim // num_heads, eps=1e-5)
        self.key_norm = nn.RMSNorm(dim // num_heads, eps=1e-5)
        self.out_proj = nn.Linear(dim, dim, bias=False)
        self.norm_ff = nn.LayerNorm(dim, bias=False)
        self.up = nn.Linear(dim, feed_forward_dim, bias=False)
        self.down = nn.Linear(feed_forward_dim, dim, bias=False)

    def forward(self, z: Tensor) -> Tensor:
        """`[B, N, D]` to `[B, N, D]`."""
        parts = self.in_proj(self.norm_attn(z)).chunk(3, -1)
        q, k, v = (part.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for part in parts)  # [B, H, N, d]
        mixed = F.scaled_dot_product_attention(self.query_norm(q), self.key_norm(k), v)
        z = z + self.out_proj(mixed.transpose(1, 2).flatten(-2))
        return z + self.down(F.gelu(self.up(self.norm_ff(z))))

    def rust_layers(self) -> dict[str, nn.Module]:
        return {
            "norm_attn": self.norm_attn,
            "attn.in_proj": self.in_proj,
            "attn.qk_norm.query": self.query_norm,
            "attn.qk_norm.key": self.key_norm,
            "attn.out_proj": self.out_proj,
            "norm_ff": self.norm_ff,
            "feed_forward.up": self.up,
            "feed_forward.down": self.down,
        }


class Latents(nn.Module):
    """Learned tokens `[1, L, D]`."""

    def __init__(self, num_latents: int, dim: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(1, num_latents, dim))
        self.bias = None
        nn.init.trunc_normal_(self.weight, std=0.02, a=-0.04, b=0.04)


class Lvsm(nn.Module):
    """Learned latents, encoded beside the patches of the context views and decoded beside those of a target view."""

    def __init__(self, config: LvsmConfig):
        super().__init__()
        c = config
        blocks = lambda count: nn.ModuleList(Block(c.dim, c.num_heads, c.feed_forward_dim) for _ in range(count))
        self.latents = Latents(c.num_latents, c.dim)
        self.patch_embed = nn.Linear(twin.CONTEXT_PATCH_DIM, c.dim, bias=False)
        self.encoder = blocks(c.num_encoder_blocks)
        self.ray_embed = nn.Linear(twin.RAY_PATCH_DIM, c.dim, bias=False)
        self.input_norm = nn.LayerNorm(c.dim, bias=False)
        self.decoder = blocks(c.num_renderer_blocks)
        self.output_norm = nn.LayerNorm(c.dim, bias=False)
        self.to_pixels = nn.Linear(c.dim, twin.PIXEL_PATCH_DIM, bias=False)
        for stack in (self.encoder, self.decoder):
            for index, block in enumerate(stack):
                for layer in (block.in_proj, block.out_proj, block.up, block.down):
                    nn.init.normal_(layer.weight, std=0.02 / (2 * (index + 1)) ** 0.5)
        for layer in (self.patch_embed, self.ray_embed, self.to_pixels):
            nn.init.normal_(layer.weight, std=0.02)

    def encode(self, images: Tensor, intrinsics: Tensor, c2w: Tensor) -> Tensor:
        """Posed context images `[B, V, H, W, 3]` to latents `[B, L, D]`."""
        rays = twin.plucker(intrinsics, c2w, *images.shape[2:4])
        patches = self.patch_embed(twin.context_patches(2 * images - 1, rays))
        latents = self.latents.weight.expand(len(patches), -1, -1)
        tokens = torch.cat([latents, patches], 1)
        for block in self.encoder:
            tokens = block(tokens)
        return tokens[:, : latents.shape[1]]

    def render(self, memory: Tensor, intrinsics: Tensor, c2w: Tensor, height: int, width: int) -> Tensor:
        """Latents `[B, L, D]` and target cameras `[B, T, ..]` to pictures `[B, T, H, W, 3]`."""
        rays = twin.plucker(intrinsics, c2w, height, width)
        batch, targets = rays.shape[:2]
        patches = self.ray_embed(twin.patchify(rays.flatten(0, 1)[:, None]))  # [B*T, Q, D]
        tokens = self.input_norm(torch.cat([patches, memory.repeat_interleave(targets, 0)], 1))
        for block in self.decoder:
            tokens = block(tokens)
        pixels = torch.sigmoid(self.to_pixels(self.output_norm(tokens[:, : patches.shape[1]])))
        return twin.unpatchify(pixels, height, width).reshape(batch, targets, height, width, twin.COLOR_CHANNELS)

    def rust_layers(self) -> dict[str, nn.Module]:
        return {
            "encoder.latents": self.latents,
            "encoder.patch_embed": self.patch_embed,
            "encoder.blocks": self.encoder,
            "renderer.ray_embed": self.ray_embed,
            "renderer.joint.input_norm": self.input_norm,
            "renderer.joint.blocks": self.decoder,
            "renderer.output_norm": self.output_norm,
            "renderer.to_pixels": self.to_pixels,
        }
