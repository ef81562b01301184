"""Averages the weights of two models of one network: `python scripts/tools/average_models.py A B -o OUT`

A is a model directory, B a model directory or one stage of a run that continues A. OUT receives the config of A and the mean of
both weights, in the precision of A. Where B has no condenser, its condenser counts as an untrained one, whose gates are
zero: the gates of the mean are half of those of A, and the other weights of its condenser are those of A.
Needs numpy and safetensors (scripts/requirements.txt).
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
from safetensors import safe_open
from safetensors.numpy import load_file, save_file


def average(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    mean = {}
    for name, value in a.items():
        other = b.get(name)
        if other is None and not name.startswith("condenser."):
            raise SystemExit(f"only the first model has {name}")
        if other is None:
            other = np.zeros_like(value) if ".gate." in name else value
        if other.shape != value.shape:
            raise SystemExit(f"{name} is {list(value.shape)} in the first model, {list(other.shape)} in the second")
        mean[name] = ((value.astype(np.float32) + other.astype(np.float32)) / 2).astype(value.dtype)
    if extra := sorted(b.keys() - a.keys()):
        raise SystemExit(f"only the second model has {extra[0]}")
    return mean


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs=2, type=Path, metavar="MODEL")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT", help="a new model directory")
    options = parser.parse_args()
    first, second = (model / "model.safetensors" for model in options.models)
    with safe_open(first, framework="numpy") as file:
        metadata = file.metadata()
    mean = average(load_file(first), load_file(second))
    options.out.mkdir(parents=True)
    save_file(mean, options.out / "model.safetensors", metadata=metadata)
    shutil.copy(options.models[0] / "config.toml", options.out)


if __name__ == "__main__":
    main()
