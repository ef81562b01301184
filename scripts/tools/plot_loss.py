"""Draws the training losses of several runs over each other, as an SVG: `python scripts/tools/plot_loss.py OUT.svg NAME=RUN..`

A run is a directory that `clift train` wrote; the curve is the mean over windows of 20 steps of its `metrics.jsonl`,
stage 2 after stage 1. Needs Python 3.11 and nothing else. Prints the means of longer windows as a Markdown table.
"""

from __future__ import annotations

import json
import math
import sys
from html import escape
from pathlib import Path

WIDTH, HEIGHT = 720, 320
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 16, 44
COLORS = ["#8a8f98", "#c2410c", "#1d4ed8", "#15803d"]
WINDOW, TABLE_WINDOWS = 20, 8


def losses(run: Path) -> dict[str, list[float]]:
    """The loss of every step of each stage."""
    stages: dict[str, list[float]] = {}
    with (run / "metrics.jsonl").open() as file:
        for line in file:
            row = json.loads(line)
            if row.get("loss") is not None:
                stages.setdefault(row["stage"], []).append(row["loss"])
    return stages


def means(values: list[float], window: int) -> list[float]:
    windows = [values[i : i + window] for i in range(0, len(values), window)]
    return [sum(window) / len(window) for window in windows]


def svg(curves: dict[str, list[float]]) -> str:
    """Logarithm of the loss over steps."""
    steps = max(len(curve) for curve in curves.values()) * WINDOW
    flat = [math.log10(value) for curve in curves.values() for value in curve]
    low, high = min(flat), max(flat)

    def x(step: float) -> float:
        return LEFT + step / steps * (WIDTH - LEFT - RIGHT)

    def y(logarithm: float) -> float:
        return TOP + (high - logarithm) / (high - low) * (HEIGHT - TOP - BOTTOM)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="12">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff"/>',
    ]
    ticks = [m * 10.0**e for e in range(-6, 1) for m in (1, 2, 5) if low <= math.log10(m * 10.0**e) <= high]
    for tick in ticks:
        at = y(math.log10(tick))
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}" stroke="#e5e7eb"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{at + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for step in range(0, steps + 1, 500):
        parts.append(f'<text x="{x(step):.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{step}</text>')
    for i, (name, curve) in enumerate(curves.items()):
        points = " ".join(f"{x((j + 0.5) * WINDOW):.1f},{y(math.log10(v)):.1f}" for j, v in enumerate(curve))
        color = COLORS[i % len(COLORS)]
        width = 3.5 if i == 0 else 1.2  # the first shows where the others cover it
        parts.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="{width}"/>')
        parts.append(f'<text x="{WIDTH - RIGHT}" y="{TOP + 14 + 16 * i}" text-anchor="end" fill="{color}">{escape(name)}</text>')
    parts.append(f'<text x="{(WIDTH + LEFT) / 2}" y="{HEIGHT - 6}" text-anchor="middle">step, stage 2 after stage 1</text>')
    parts.append(f'<text x="14" y="{HEIGHT / 2}" transform="rotate(-90 14 {HEIGHT / 2})" text-anchor="middle">loss</text>')
    return "\n".join([*parts, "</svg>", ""])


def main(arguments: list[str]) -> int:
    if len(arguments) < 2 or not all("=" in argument for argument in arguments[1:]):
        print(__doc__, file=sys.stderr)
        return 2
    runs = {name: losses(Path(path)) for name, path in (argument.split("=", 1) for argument in arguments[1:])}
    curves = {name: means([v for stage in run.values() for v in stage], WINDOW) for name, run in runs.items()}
    Path(arguments[0]).write_text(svg(curves))
    print("| steps | " + " | ".join(runs) + " |")
    print("|---|" + "---|" * len(runs))
    for stage in next(iter(runs.values())):
        count = len(next(iter(runs.values()))[stage])
        window = math.ceil(count / TABLE_WINDOWS)
        columns = [means(run.get(stage, []), window) for run in runs.values()]
        for i, row in enumerate(zip(*columns)):
            last = min((i + 1) * window, count)
            print(f"| {stage} {i * window + 1}-{last} | " + " | ".join(f"{value:.5f}" for value in row) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
