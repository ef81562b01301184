#!/usr/bin/env python3
"""Which options of training are worth their time?

Trains stage 1 of a config with every variant below for the same wall time, and prints the PSNR of held-out scenes as a
Markdown table: mean over seeds and its standard error. The time of a step is measured first, one variant after the
other on all cores (keep the machine quiet); the seeds then train for as many steps as fit the budget, with --jobs side by
side, because the result depends on the steps alone. Results are kept: an interrupted benchmark resumes.

    python3 scripts/bench/recipe.py --seconds 70 --seeds 0,1,2 --jobs 2 --out runs/recipe
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import statistics
import subprocess
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TIMED_STEPS = 60
VALIDATION = re.compile(r"stage1 step (\d+): ([\d.]+) dB, SSIM ([\d.]+)")


def optimizer(**changes: object) -> str:
    values = dict(algorithm="adamw", learning_rate=1.5e-3, warm_up_steps=100) | changes
    return "stage1.optimizer={" + ", ".join(f"{key}={json.dumps(value)}" for key, value in values.items()) + "}"


PLUCKER, GTA = (f'model.camera_encoding="{name}"' for name in ("plucker", "gta"))
PATCH_4, PATCH_8 = "model.patch_size=4", "model.patch_size=8"
ADAMW, MUON = optimizer(), optimizer(algorithm="muon", learning_rate=6e-3)
FULL_SIZE = "stage1.half_resolution=0"
# The options one by one and together, all with a cosine, then the config itself ("whole") and changes of it.
TRAINED = {
    "baseline recipe": [PATCH_8, PLUCKER, ADAMW, FULL_SIZE],
    "gta": [PATCH_8, GTA, ADAMW, FULL_SIZE],
    "patch of 4": [PATCH_4, PLUCKER, ADAMW, FULL_SIZE],
    "Muon": [PATCH_8, PLUCKER, MUON, FULL_SIZE],
    "patch of 4, gta": [PATCH_4, GTA, ADAMW, FULL_SIZE],
    "patch of 4, Muon": [PATCH_4, PLUCKER, MUON, FULL_SIZE],
    "patch of 4, Muon, gta": [PATCH_4, GTA, MUON, FULL_SIZE],
    "whole, no half resolution": [FULL_SIZE],
    "whole": [],
    "whole, 5 targets a scene": ["data.views.num_targets=5"],
    "whole, 4 scenes of 6 targets": ["data.views.num_targets=6", "stage1.batch_size=4"],
}
# Rendered on one patch grid, which training does not depend on; the config's own number comes last.
VARIANTS = {name: [*changes, "model.patch_grids=1"] for name, changes in TRAINED.items()} | {"whole, patch grids": []}


class Bench:
    def __init__(self, args: argparse.Namespace):
        self.exe, self.config, self.out = args.exe.resolve(), args.config, args.out.resolve()
        self.seconds, self.jobs = args.seconds, args.jobs

    def train(self, run: Path, changes: list[str], threads: int | None) -> str:
        """Trains stage 1 in `run` and returns what the program printed."""
        command = [self.exe, "train", self.config, "--only", "stage1", "--set", f"run_dir={json.dumps(str(run))}"]
        for change in changes:
            command += ["--set", change]
        environment = os.environ | ({"RAYON_NUM_THREADS": str(threads)} if threads else {})
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{run}: {done.stderr}")
        return done.stdout + done.stderr

    def step_s(self, name: str) -> float:
        """Mean over the image sizes of the median seconds of a step, alone on all cores."""
        run = self.out / f"timed-{slug(name)}"
        if not (run / "stage1" / "model.safetensors").exists():
            self.train(run, [*VARIANTS[name], f"stage1.steps={TIMED_STEPS}", "eval.every=0"], None)
        rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        times = [row["step_s"] for row in rows if "step_s" in row]
        stage1 = tomllib.loads((run / "config.toml").read_text())["stage1"]
        num_half = int(stage1.get("half_resolution", 0) * TIMED_STEPS + 1e-6)
        parts = [part for part in (times[:num_half], times[num_half:]) if part]
        return sum(len(part) * statistics.median(part[5:]) for part in parts) / TIMED_STEPS

    def result(self, name: str, seed: int, num_steps: int) -> tuple[float, float]:
        """PSNR and SSIM of held-out scenes after the budget."""
        file = self.out / f"{slug(name)}-{seed}.json"
        if not file.exists():
            changes = [f"seed={seed}", f"stage1.steps={num_steps}", f"eval.every={num_steps}"]
            changes += ["eval.num_validation_scenes=64", f"checkpoint.every={num_steps}"]
            threads = max(1, (os.cpu_count() or 1) // self.jobs)
            printed = self.train(self.out / f"{slug(name)}-{seed}", VARIANTS[name] + changes, threads)
            _, psnr, ssim = VALIDATION.findall(printed)[-1]
            file.write_text(json.dumps({"steps": num_steps, "psnr": float(psnr), "ssim": float(ssim)}))
        stored = json.loads(file.read_text())
        return stored["psnr"], stored["ssim"]


def slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower())


def with_error(values: list[float], digits: int) -> str:
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    error = statistics.stdev(values) / math.sqrt(len(values))
    return f"{statistics.fmean(values):.{digits}f} +- {error:.{digits}f}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Compares options of training at equal wall time.")
    parser.add_argument("--exe", type=Path, default=ROOT / "target/release/clift")
    parser.add_argument("--config", default="configs/tiny.toml")
    parser.add_argument("--out", type=Path, default=ROOT / "runs/recipe")
    parser.add_argument("--seconds", type=float, default=70.0, help="wall time of stage 1 on all cores")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--jobs", type=int, default=1, help="trainings side by side, after the times are measured")
    parser.add_argument("--only", nargs="+", default=list(VARIANTS), choices=VARIANTS, help="variants to train")
    args = parser.parse_args()
    bench, seeds = Bench(args), [int(seed) for seed in args.seeds.split(",")]
    names = args.only
    times = {name: bench.step_s(name) for name in names}
    tasks = [(name, seed, int(args.seconds / times[name])) for name in names for seed in seeds]
    with ThreadPoolExecutor(args.jobs) as pool:
        results = dict(zip(tasks, pool.map(lambda task: bench.result(*task), tasks)))
    print(f"| variant | ms a step | steps in {args.seconds:g} s | PSNR dB | SSIM |\n|---|---|---|---|---|")
    for name in names:
        psnr, ssim = zip(*(value for (of, _, _), value in results.items() if of == name))
        steps = int(args.seconds / times[name])
        print(f"| {name} | {1e3 * times[name]:.0f} | {steps} | {with_error(psnr, 2)} | {with_error(ssim, 3)} |")


if __name__ == "__main__":
    main()
