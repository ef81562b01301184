"""Draws several runs over each other, as an SVG: `python scripts/tools/plot_runs.py loss|psnr OUT.svg NAME=RUN..`

A run is a directory that `clift train` or scripts/bench/train_twin.py wrote. `loss` draws the training loss over steps,
stage 2 after stage 1: means over windows of 20 steps of metrics.jsonl. `psnr` draws the validations of stage 1 over
minutes of training, the sum of the times of the steps. Needs Python 3.11 and nothing else. Prints a Markdown table.
"""

from __future__ import annotations

import json
import math
import sys
from html import escape
from itertools import accumulate
from pathlib import Path

WIDTH, HEIGHT = 720, 320
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 16, 44
COLORS = ["#8a8f98", "#c2410c", "#1d4ed8", "#15803d"]
WINDOW, TABLE_WINDOWS = 20, 8
Curve = list[tuple[float, float]]


def rows(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def losses(run: Path) -> dict[str, list[float]]:
    """The loss of every step of each stage."""
    stages: dict[str, list[float]] = {}
    for row in rows(run / "metrics.jsonl"):
        if row.get("loss") is not None:
            stages.setdefault(row["stage"], []).append(row["loss"])
    return stages


def psnr_by_minutes(run: Path) -> Curve:
    steps = {row["step"]: row["step_s"] for row in rows(run / "metrics.jsonl") if row["stage"] == "stage1" and "step_s" in row}
    minutes = dict(zip(sorted(steps), accumulate(steps[step] / 60.0 for step in sorted(steps))))
    return [(minutes[row["step"]], row["psnr"]) for row in rows(run / "validation.jsonl") if row["stage"] == "stage1"]


def means(values: list[float], window: int) -> list[float]:
    windows = [values[i : i + window] for i in range(0, len(values), window)]
    return [sum(window) / len(window) for window in windows]


def svg(curves: dict[str, Curve], x_ticks: list[float], y_ticks: dict[float, str], labels: tuple[str, str], legend: str) -> str:
    """Lines through the points of every curve; `legend` is "top" or "bottom", at the right edge."""
    most = max(x for curve in curves.values() for x, _ in curve)
    flat = [y for curve in curves.values() for _, y in curve]
    low, high = min(flat), max(flat)

    def across(x: float) -> float:
        return LEFT + x / most * (WIDTH - LEFT - RIGHT)

    def down(y: float) -> float:
        return TOP + (high - y) / (high - low) * (HEIGHT - TOP - BOTTOM)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff"/>',
    ]
    for y, text in y_ticks.items():
        if low <= y <= high:
            parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{down(y):.1f}" y2="{down(y):.1f}" stroke="#e5e7eb"/>')
            parts.append(f'<text x="{LEFT - 8}" y="{down(y) + 4:.1f}" text-anchor="end">{text}</text>')
    for x in x_ticks:
        if x <= most:
            parts.append(f'<text x="{across(x):.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{x:g}</text>')
    first = TOP + 14 if legend == "top" else HEIGHT - BOTTOM - 16 * len(curves)
    for i, (name, curve) in enumerate(curves.items()):
        points = " ".join(f"{across(x):.1f},{down(y):.1f}" for x, y in curve)
        color = COLORS[i % len(COLORS)]
        width = 3.5 if i == 0 else 1.5  # the first shows where the others cover it
        parts.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="{width}"/>')
        parts.append(f'<text x="{WIDTH - RIGHT}" y="{first + 16 * i}" text-anchor="end" fill="{color}">{escape(name)}</text>')
    parts.append(f'<text x="{(WIDTH + LEFT) / 2}" y="{HEIGHT - 6}" text-anchor="middle">{labels[0]}</text>')
    parts.append(f'<text x="14" y="{HEIGHT / 2}" transform="rotate(-90 14 {HEIGHT / 2})" text-anchor="middle">{labels[1]}</text>')
    return "\n".join([*parts, "</svg>", ""])


def draw_losses(out: Path, folders: dict[str, Path]) -> None:
    runs = {name: losses(path) for name, path in folders.items()}
    curves = {}
    for name, run in runs.items():
        windows = means([value for stage in run.values() for value in stage], WINDOW)
        curves[name] = [((i + 0.5) * WINDOW, math.log10(value)) for i, value in enumerate(windows)]
    ticks = {math.log10(m * 10.0**e): f"{m * 10.0**e:g}" for e in range(-6, 1) for m in (1, 2, 5)}
    out.write_text(svg(curves, list(range(0, 1_000_000, 500)), ticks, ("step, stage 2 after stage 1", "loss"), "top"))
    print("| steps | " + " | ".join(runs) + " |")
    print("|---|" + "---|" * len(runs))
    for stage in next(iter(runs.values())):
        count = len(next(iter(runs.values()))[stage])
        window = math.ceil(count / TABLE_WINDOWS)
        columns = [means(run.get(stage, []), window) for run in runs.values()]
        for i, row in enumerate(zip(*columns)):
            last = min((i + 1) * window, count)
            print(f"| {stage} {i * window + 1}-{last} | " + " | ".join(f"{value:.5f}" for value in row) + " |")


def draw_psnr(out: Path, folders: dict[str, Path]) -> None:
    curves = {name: psnr_by_minutes(path) for name, path in folders.items()}
    longest = max(x for curve in curves.values() for x, _ in curve)
    step = next(step for step in (0.25, 0.5, 1, 2, 5, 10, 20, 60) if longest / step <= 12)
    x_ticks = [i * step for i in range(13)]
    y_ticks = {float(y): str(y) for y in range(60)}
    out.write_text(svg(curves, x_ticks, y_ticks, ("minutes of training", "held-out PSNR, dB"), "bottom"))
    print("| run | minutes | PSNR dB |")
    print("|---|---|---|")
    for name, curve in curves.items():
        print(f"| {name} | {curve[-1][0]:.2f} | {curve[-1][1]:.2f} |")


def main(arguments: list[str]) -> int:
    kinds = {"loss": draw_losses, "psnr": draw_psnr}
    if len(arguments) < 3 or arguments[0] not in kinds or not all("=" in argument for argument in arguments[2:]):
        print(__doc__, file=sys.stderr)
        return 2
    folders = {name: Path(path) for name, path in (argument.split("=", 1) for argument in arguments[2:])}
    kinds[arguments[0]](Path(arguments[1]), folders)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
