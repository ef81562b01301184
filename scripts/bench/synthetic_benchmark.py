#!/usr/bin/env python3
"""Does the paper's order of variants hold on rooms that were never seen?

For each seed: trains configs/synthetic.toml; trains two further condensers on the same stage 1, one on tiles of the views
and one without residuals (the equations as printed); evaluates all of them on the same views. Prints a table per
comparison: the difference of each seed over its scenes with its standard error, and the mean over seeds.

Existing results are kept, so that an interrupted benchmark resumes. With --jobs, seeds are trained
side by side, each on its share of the cores, which takes less time in all; what they print is in OUT/seed-N.log then.

    python3 scripts/bench/synthetic_benchmark.py --seeds 0,1,2 --jobs 3
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import statistics
import subprocess
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VARIANTS = "random,tile,tile_clift,kmeans,clift"
STORAGE = "1/16,1/8,1/4,1/2,1.0"


def quoted(path: Path) -> str:
    """A path as TOML, relative paths being those of the caller."""
    return json.dumps(str(path.resolve()))


@dataclass
class Seed:
    """The runs of one seed of training."""

    exe: Path
    config: Path
    out: Path
    seed: int
    threads: int | None
    """Threads of a process that has others beside it; None for one that has the machine."""

    def run(self, name: str) -> Path:
        return self.out / f"{name}-{self.seed}"

    def clift(self, *args: str) -> None:
        if self.threads is None:
            subprocess.run([self.exe, *args], check=True, cwd=ROOT)
            return
        environment = os.environ | {"RAYON_NUM_THREADS": str(self.threads)}
        with self.out.joinpath(f"seed-{self.seed}.log").open("a") as log:
            subprocess.run([self.exe, *args], check=True, cwd=ROOT, env=environment, stdout=log, stderr=log)

    def train(self, name: str, *changes: str) -> None:
        run = self.run(name)
        if (run / "eval" / "summary.json").exists():
            return
        args = ["train", str(self.config.resolve()), "--set", f"run_dir={quoted(run)}", "--set", f"seed={self.seed}"]
        for change in changes:
            args += ["--set", change]
        self.clift(*args)

    def same_stage1(self, name: str, change: str) -> None:
        self.train(name, "stage1.steps=0", f"stage1.init_from={quoted(self.run('kmeans'))}", change)

    def compare(self) -> None:
        """Evaluates both groupings, each with and without its condenser, and random tokens."""
        if (self.compared / "summary.json").exists():
            return
        variants = "[" + ",".join(f'"{name}"' for name in VARIANTS.split(",")) + "]"
        self.clift(
            "eval", str(self.run("kmeans").resolve()), "--with", str(self.run("tiles").resolve()),
            "--storage", STORAGE, "--set", f"eval.variants={variants}", "--out", str(self.compared.resolve()),
        )  # fmt: skip

    @property
    def compared(self) -> Path:
        return self.run("kmeans") / "compared"

    def make(self) -> tuple[Path, Path]:
        """Trains and evaluates; the folders of the evaluations with and without residuals in the condenser."""
        self.train("kmeans")
        self.same_stage1("tiles", 'clusters.grouping="tile"')
        self.compare()
        self.same_stage1("literal", "model.condenser.residual=false")
        return self.compared, self.run("literal") / "eval"


def scene_means(folder: Path) -> dict[tuple[str, int], dict[str, float]]:
    """Mean PSNR of every scene by (method, tokens), of views rendered from all tokens."""
    values: dict[tuple[str, int], dict[str, list[float]]] = {}
    with (folder / "views.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if row["num_storage_tokens"] == row["num_render_tokens"]:
                scenes = values.setdefault((row["method"], int(row["num_storage_tokens"])), {})
                scenes.setdefault(row["scene"], []).append(min(float(row["psnr"]), 100.0))
    return {key: {scene: statistics.fmean(v) for scene, v in scenes.items()} for key, scenes in values.items()}


def difference(better: dict[str, float], worse: dict[str, float]) -> tuple[float, float]:
    """Mean over the scenes of both, and its standard error."""
    values = [better[scene] - worse[scene] for scene in better if scene in worse]
    return statistics.fmean(values), statistics.stdev(values) / math.sqrt(len(values))


COMPARISONS = [
    ("K-means - random", "kmeans", "random"),
    ("condenser - K-means", "clift", "kmeans"),
    ("K-means - tiles", "kmeans", "tile"),
    ("condenser on tiles - tiles", "tile_clift", "tile"),
    ("condenser - condenser on tiles", "clift", "tile_clift"),
    ("residuals - equations as printed", "clift", "literal"),
]


def report(folders: list[tuple[Path, Path]]) -> None:
    seeds = []
    for compared, literal in folders:
        means = scene_means(compared)
        means |= {("literal", count): v for (name, count), v in scene_means(literal).items() if name == "clift"}
        seeds.append(means)
    counts = sorted({count for _, count in seeds[0] if count > 0})
    num_scenes = len(next(iter(seeds[0].values())))
    print(f"\nPSNR in dB, {num_scenes} scenes, mean over {len(seeds)} seeds of training\n")
    print("| variant | " + " | ".join(str(count) for count in counts) + " |")
    print("|---|" + "---|" * len(counts))
    for name in ("random", "tile", "tile_clift", "kmeans", "literal", "clift"):
        cells = []
        for count in counts:
            values = [statistics.fmean(s[name, count].values()) for s in seeds if (name, count) in s]
            cells.append(f"{statistics.fmean(values):.2f}" if values else "-")
        print(f"| {name} | " + " | ".join(cells) + " |")
    print("\nDifferences in dB: mean over seeds (each seed, +- its standard error over scenes)\n")
    print("| comparison | " + " | ".join(f"{count} tokens" for count in counts if count < counts[-1]) + " |")
    print("|---|" + "---|" * (len(counts) - 1))
    for title, better, worse in COMPARISONS:
        cells = []
        for count in counts[:-1]:
            found = [s for s in seeds if (better, count) in s and (worse, count) in s]
            pairs = [difference(s[better, count], s[worse, count]) for s in found]
            each = ", ".join(f"{mean:+.2f} +- {error:.2f}" for mean, error in pairs)
            cells.append(f"**{statistics.fmean(m for m, _ in pairs):+.2f}** ({each})" if pairs else "-")
        print(f"| {title} | " + " | ".join(cells) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0,1,2", help="seeds of training, separated by commas")
    parser.add_argument("--jobs", type=int, default=1, help="seeds that are trained at once")
    parser.add_argument("--config", type=Path, default=ROOT / "configs" / "synthetic.toml")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "synthetic", help="folder of the runs")
    parser.add_argument("--clift", type=Path, default=ROOT / "target" / "release" / "clift")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    threads = max(1, (os.cpu_count() or 1) // args.jobs) if args.jobs > 1 else None
    seeds = [Seed(args.clift.resolve(), args.config, args.out, int(seed), threads) for seed in args.seeds.split(",")]
    with ThreadPoolExecutor(args.jobs) as pool:
        folders = list(pool.map(Seed.make, seeds))
    report(folders)


if __name__ == "__main__":
    main()
