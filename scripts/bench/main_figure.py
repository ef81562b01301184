#!/usr/bin/env python3
"""The paper's main figure: CLiFT of one training at every size against an LVSM encoder-decoder trained for each size.

Trains CLiFT, then LVSM for every number of latents twice: for as many steps as both stages of CLiFT together, and for as
long as their steps took. Further seeds train CLiFT and the smallest LVSM. Every seed is evaluated with `clift eval
--preset main --with ..`; the tables have PSNR with its standard error (over seeds, where there are several, else over
scenes), tokens, values, bytes, GMAC and measured time a view; main-figure.svg draws PSNR over tokens. Keep the machine
quiet: the second table depends on the times of steps. Trainings resume; finished ones are kept.

    python3 scripts/bench/main_figure.py --out runs/main-figure                      # hours on two cores
    python3 scripts/bench/main_figure.py --clift-config configs/tiny.toml --lvsm-config configs/lvsm-ed-tiny.toml \\
        --latents 32,64,128 --out runs/main-figure-tiny
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts" / "tools"))
from plot_runs import svg

FORMATS = ["f16", "coded", "coded-0.1"]


class Figure:
    def __init__(self, args: argparse.Namespace):
        self.exe, self.out = args.exe.resolve(), args.out.resolve()
        self.set = {"clift": [*args.clift_set, *args.set], "lvsm": args.set}
        self.configs = {"clift": args.clift_config, "lvsm": args.lvsm_config}

    def clift(self, *words: str) -> None:
        done = subprocess.run([self.exe, *words], cwd=ROOT)
        if done.returncode:
            raise SystemExit(f"clift {' '.join(words)}: exit code {done.returncode}")

    def train(self, kind: str, name: str, seed: int, *changes: str) -> Path:
        run = self.out / name
        # Steps of one kind: LVSM-ED's equal time is counted in them.
        changes = (f"run_dir={json.dumps(str(run))}", f"seed={seed}", "stage1.half_resolution=0", *changes, *self.set[kind])
        self.clift("train", str(self.configs[kind]), *(word for change in changes for word in ("--set", change)))
        return run

    def evaluate(self, run: Path, others: list[Path], name: str) -> list[dict]:
        out = self.out / f"eval-{name}"
        if not (out / "summary.json").exists():
            beside = [word for other in others for word in ("--with", str(other))]
            self.clift("eval", str(run), "--preset", "main", *beside, "--out", str(out))
        return json.loads((out / "summary.json").read_text())["points"]


def steps(run: Path) -> dict[str, list[float]]:
    """Seconds of every step by stage."""
    found: dict[str, list[float]] = {}
    for line in (run / "metrics.jsonl").read_text().splitlines():
        row = json.loads(line)
        found.setdefault(row["stage"], []).append(row["step_s"])
    return found


def num_steps(run: Path) -> int:
    return sum(len(stage) for stage in steps(run).values())


def seconds(run: Path) -> float:
    """Time of all steps at the median of their stage, so that an interruption of the machine does not count."""
    return sum(len(stage) * statistics.median(stage) for stage in steps(run).values())


def cell(values: list[float], digits: int) -> str:
    return f"{statistics.fmean(values):.{digits}f}" if all(value is not None for value in values) else "-"


def table(title: str, evaluations: list[list[dict]]) -> None:
    found: dict[tuple, list[dict]] = {}
    for points in evaluations:
        for point in points:
            key = (point["method"], FORMATS.index(point["tokens"]), point["num_storage_tokens"])
            found.setdefault(key, []).append(point)
    print(f"\n{title}\n\n| method | tokens | storage | seeds | PSNR dB | SSIM | values | kB | GMAC | ms a view |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for (method, storage, tokens), points in sorted(found.items()):
        psnr = [point["psnr"] for point in points]
        error = points[0]["psnr_stderr"] if len(psnr) == 1 else statistics.stdev(psnr) / len(psnr) ** 0.5
        of = lambda name, factor, digits: cell([point[name] and point[name] * factor for point in points], digits)
        print(
            f"| {method} | {tokens} | {FORMATS[storage]} | {len(psnr)} | {statistics.fmean(psnr):.2f} +- {error or 0:.2f} "
            f"| {of('ssim', 1, 3)} | {points[0]['scene_values']} | {of('scene_bytes', 1e-3, 1)} | {of('gflops', 1, 3)} "
            f"| {of('render_median_s', 1e3, 1)} |"
        )


def curve(evaluations: list[list[dict]], method: str) -> list[tuple[float, float]]:
    """Mean PSNR of a method in f16 by the number of stored tokens."""
    found: dict[int, list[float]] = {}
    for point in (point for points in evaluations for point in points):
        if point["method"] == method and point["tokens"] == "f16":
            found.setdefault(point["num_storage_tokens"], []).append(point["psnr"])
    return sorted((tokens, statistics.fmean(psnr)) for tokens, psnr in found.items())


def plot(out: Path, evaluations: dict[str, list[list[dict]]]) -> None:
    curves = {
        "CLiFT, one training": curve(evaluations["steps"], "clift"),
        "LVSM-ED, a training for each size, equal time": curve(evaluations["time"], "lvsm_ed"),
        "LVSM-ED, a training for each size, equal steps": curve(evaluations["steps"], "lvsm_ed"),
    }
    tokens = [x for x, _ in curves["CLiFT, one training"]]
    y_ticks = {half / 2: f"{half / 2:g}" for half in range(120)}
    out.write_text(svg(curves, tokens, y_ticks, ("stored tokens", "PSNR, dB"), "bottom"))


def main() -> None:
    parser = argparse.ArgumentParser(description="The paper's main figure, CLiFT against LVSM-ED.")
    parser.add_argument("--exe", type=Path, default=ROOT / "target/release/clift")
    parser.add_argument("--clift-config", type=Path, default=ROOT / "configs/synthetic.toml")
    parser.add_argument("--lvsm-config", type=Path, default=ROOT / "configs/lvsm-ed-synthetic.toml")
    parser.add_argument("--out", type=Path, default=ROOT / "runs/main-figure")
    parser.add_argument("--latents", default="64,256,1024", help="numbers of latents, the smallest first")
    parser.add_argument("--seeds", default="0,1,2", help="the first trains every size, the others the smallest")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=TOML", help="changes both configs")
    parser.add_argument("--clift-set", action="append", default=[], metavar="KEY=TOML", help="changes CLiFT's config")
    args = parser.parse_args()
    figure, latents = Figure(args), [int(count) for count in args.latents.split(",")]
    evaluations: dict[str, list[list[dict]]] = {"steps": [], "time": []}
    for number, seed in enumerate(int(seed) for seed in args.seeds.split(",")):
        clift = figure.train("clift", f"clift-{seed}", seed)
        others: dict[str, list[Path]] = {"steps": [], "time": []}
        for count in latents[: 1 if number else None]:

            def lvsm(kind: str, length: int) -> Path:
                changes = (f"model.num_latents={count}", f"stage1.steps={length}")
                return figure.train("lvsm", f"lvsm-{count}-{kind}-{seed}", seed, *changes)

            others["steps"].append(lvsm("steps", num_steps(clift)))
            step_s = statistics.median(steps(others["steps"][-1])["stage1"])
            # Written down once: a resumed training needs the same number of steps.
            file = figure.out / f"lvsm-{count}-time-{seed}.json"
            if not file.exists():
                file.write_text(json.dumps(round(seconds(clift) / step_s)))
            others["time"].append(lvsm("time", json.loads(file.read_text())))
        for kind, runs in others.items():
            evaluations[kind].append(figure.evaluate(clift, runs, f"{kind}-{seed}"))
            sizes = ", ".join(f"{run.name}: {num_steps(run)} steps, {seconds(run):.0f} s" for run in [clift, *runs])
            print(f"seed {seed}, equal {kind}: {sizes}")
    for kind, points in evaluations.items():
        table(f"Equal {kind}", points)
    plot(figure.out / "main-figure.svg", evaluations)


if __name__ == "__main__":
    main()
