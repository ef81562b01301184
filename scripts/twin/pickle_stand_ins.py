"""Objects as Lightning checkpoints hold them beside the weights, from modules that nobody else has.

`install` registers the modules that the objects of a made-up training project come from, so that
this machine can write and read a checkpoint with them; clift must skip them unread.
"""

from __future__ import annotations

import collections
import functools
import pathlib
import sys
import types
from enum import Enum

import numpy as np
import torch


class ModelConfig:
    """A configuration object of a project, pickled by name and __dict__."""

    def __init__(self, **values):
        self.__dict__.update(values)


class Mode(Enum):
    """An enumeration, pickled as a call."""

    TRAIN = "train"


class Slots:
    """An object whose state is a tuple."""

    __slots__ = ("a", "b")

    def __init__(self):
        self.a, self.b = {"deep": [1, 2, {"deeper": (3,)}]}, 2**70


def install() -> None:
    """Makes the classes above members of `project.config`."""
    module = types.ModuleType("project.config")
    sys.modules["project"] = types.ModuleType("project")
    sys.modules["project.config"] = module
    for stand_in in (ModelConfig, Mode, Slots):
        stand_in.__module__ = "project.config"
        setattr(module, stand_in.__name__, stand_in)


def lightning(state_dict: dict[str, torch.Tensor], like: torch.Tensor) -> dict:
    """A checkpoint as pytorch_lightning's trainer saves one."""
    state = collections.OrderedDict(state_dict)
    state._metadata = collections.OrderedDict({"": {"version": 1}})  # type: ignore[attr-defined]
    parameter = nn_parameter(like)
    return {
        "epoch": 129,
        "global_step": 40_000,
        "pytorch-lightning_version": "2.5.0",
        "state_dict": state,
        "loops": {"fit_loop": {"state_dict": {}, "epoch_progress": {"total": {"ready": 130}}}},
        "callbacks": {
            "ModelCheckpoint{'monitor': 'val/psnr'}": {
                "monitor": "val/psnr",
                "best_model_score": torch.tensor(27.5),
                "dirpath": pathlib.PurePosixPath("/checkpoints"),
                "kth_value": float("inf"),
            },
            "Timer": functools.partial(max, 1),
        },
        "optimizer_states": [
            {
                "state": {0: {"step": torch.tensor(40_000.0), "exp_avg": torch.zeros_like(like, dtype=torch.bfloat16)}},
                "param_groups": [{"lr": 3e-4, "betas": (0.9, 0.95), "params": [0], "fused": None}],
            }
        ],
        "lr_schedulers": [{"base_lrs": [3e-4], "last_epoch": 40_000, "lr_lambdas": [None, {}]}],
        "MixedPrecision": {"scale": 65536.0, "growth_factor": 2.0, "mask": torch.tensor([True, False])},
        "hparams_name": "cfg",
        "hyper_parameters": ModelConfig(
            mode=Mode.TRAIN,
            slots=Slots(),
            size=np.float64(1.5),
            sizes=np.arange(3),
            names={"a", "b"},
            frozen=frozenset([1]),
            raw=b"bytes\x00\xff",
            buffer=bytearray(b"abc"),
            slice=slice(1, None),
            dtype=torch.float16,
            shape=torch.Size([2, 3]),
            device=torch.device("cpu"),
            default=collections.defaultdict(list, {"x": [1]}),
            parameter=parameter,
            generator=torch.Generator().get_state(),
            long_text="x" * 300,
        ),
    }


def nn_parameter(like: torch.Tensor) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.zeros(2, dtype=like.dtype))


def read(path: str) -> dict[str, torch.Tensor]:
    """The state dict of a checkpoint made by this repository, which is trusted."""
    install()
    return torch.load(path, map_location="cpu", weights_only=False)["state_dict"]
