#!/usr/bin/env python3
"""Averages the weights of networks that were trained from one another:
python3 scripts/tools/average_weights.py FOLDER FOLDER [..] -o OUT

Every FOLDER holds a model.safetensors (runs/NAME/stage1, or a model directory). OUT gets the mean, in f32, of every tensor that
all have, those of the first folder that others lack, and the first folder's config.toml (of its run, for a stage).
"""

import argparse
import shutil
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file, save_file


def main():
    parser = argparse.ArgumentParser(description=__doc__.split(":")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    args = parser.parse_args()
    missing = [folder / "model.safetensors" for folder in args.folders if not (folder / "model.safetensors").is_file()]
    if missing:
        parser.error(f"{missing[0]} is missing: give folders of a stage (runs/NAME/stage1) or of a model")
    if args.out.exists():
        parser.error(f"{args.out} exists: give a new folder")
    first, *others = [load_file(folder / "model.safetensors") for folder in args.folders]
    mean = {}
    for name, values in first.items():
        every = [values, *(other[name] for other in others if name in other)]
        # A tensor that some lack, such as a condenser before stage 2, is taken from the first.
        every = every if len(every) == len(args.folders) else [values]
        mean[name] = np.mean([values.astype(np.float32) for values in every], axis=0)
    config = next(folder / "config.toml" for folder in (args.folders[0], args.folders[0].parent) if (folder / "config.toml").exists())
    args.out.mkdir(parents=True)
    save_file(mean, args.out / "model.safetensors")
    shutil.copy(config, args.out / "config.toml")


if __name__ == "__main__":
    main()
