"""clift beside PyTorch on one GPU: the same work, alternately, and one table with ratios of medians.

    python3 gpu_bench.py --clift ./clift --json gpu.json          # on a GPU machine; gpu_bench.sh brings all it needs
    python3 gpu_bench.py --clift ./clift --tiny                   # does everything run? seconds on flex, no judgement

Needs Python 3.11. PyTorch is looked for in the Python that `--python` names, by default this one; where it is missing
its columns stay empty, and the table has a note. The work is the paper's network on 4 contexts of 256 x 256: encoding, a
view from 512 to 4,096 tokens, an update of both stages. A figure is the median over all repetitions of all rounds.

clift computes in f32 and with f16 products, PyTorch (the twin in clift_torch.py, with fused attention and AdamW) in f32
with TF32 products and in bf16 by autocast. Every measurement is a process of its own, so that none sees another's
caches or memory; the first repetitions, which compile kernels, do not count (--warmup).

Exit codes: 0 done, 1 something failed, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench_rows import FULL, SMOKE, overrides

HERE = Path(__file__).resolve().parent
RENDER_TOKENS = (512, 1024, 2048, 4096)
OURS = ("f32", "f16")


@dataclass(frozen=True)
class Row:
    """A row of the table: a case, and the number of tokens a view is rendered from."""

    work: str
    render_tokens: int | None = None

    @property
    def name(self) -> str:
        return self.work if self.render_tokens is None else f"{self.work} {self.render_tokens}"


class Failed(Exception):
    """A process that did not do what it was asked."""


def run(command: list[str], limit_s: float) -> str:
    """What a process prints; its last words where it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit_s)
    except OSError as error:
        raise Failed(str(error)) from None
    except subprocess.TimeoutExpired:
        raise Failed(f"not done after {limit_s:.0f} s") from None
    if done.returncode != 0:
        words = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise Failed(words[-1] if words else f"exit code {done.returncode}")
    return done.stdout


class Bench:
    """Runs single measurements of either side."""

    def __init__(self, args: argparse.Namespace, size: dict[str, int], folder: Path):
        self.args, self.size, self.json = args, size, folder / "clift.json"
        self.torch = self.find_torch()

    def find_torch(self) -> dict[str, str] | str:
        """PyTorch's version and device, or why there is none."""
        if self.args.no_torch:
            return "left out (--no-torch)"
        try:
            return self.torch_process({"work": "where", "device": self.args.torch_device})
        except Failed as error:
            return f"not found by {self.args.python}: {error}"

    @property
    def torch_precisions(self) -> tuple[str, ...]:
        if isinstance(self.torch, str):
            return ()
        return ("tf32", "bf16") if self.torch["device"].startswith("cuda") else ("f32", "bf16")

    def torch_process(self, spec: dict[str, Any]) -> dict[str, Any]:
        spec = {"threads": os.cpu_count() or 1, **spec}
        command = [str(self.args.python), str(HERE / "torch_cases.py"), json.dumps(spec)]
        return json.loads(run(command, self.args.limit))

    def measure_torch(self, row: Row, precision: str) -> list[float]:
        size = self.size | ({"render_tokens": row.render_tokens} if row.render_tokens else {})
        variant = {"stage2_step": "exact sdpa"}.get(row.work, "sdpa")
        spec = dict(work=row.work, variant=variant, size=size, precision=precision, device=self.torch["device"])
        return self.torch_process(spec | dict(repeats=self.args.repeats, warmup=self.args.warmup))["samples_s"]

    def clift(self, *words: str) -> list[str]:
        sets = [word for override in overrides(self.size) for word in ("--set", override)]
        return [str(self.args.clift), *words, "--device", self.args.device, *sets]

    def measure_clift(self, row: Row, precision: str) -> list[float]:
        command = self.clift("bench", str(self.args.config), "--case", row.work, "--no-error", "--storage", "1/4")
        command += ["--repeats", str(self.args.repeats), "--warmup", str(self.args.warmup), "--json", str(self.json)]
        command += ["--set", f'precision="{precision}"']
        command += ["--render", str(row.render_tokens)] if row.render_tokens else []
        run(command, self.args.limit)
        written = json.loads(self.json.read_text())
        if written["precision"] != precision or written["device"] != self.args.device:
            raise Failed(f"clift measured {written['device']} in {written['precision']}")
        return next(one["samples_s"] for one in written["rows"] if one["case"] == row.work)

    def precision(self) -> list[dict[str, Any]] | str:
        """What f16 products change, from `clift bench precision`."""
        command = self.clift("bench", "precision", str(self.args.config))
        command += ["--repeats", str(self.args.repeats), "--warmup", str(self.args.warmup), "--json", str(self.json)]
        try:
            run(command, self.args.limit)
        except Failed as error:
            return str(error)
        return json.loads(self.json.read_text())["rows"]


def measure(bench: Bench, rows: list[Row], rounds: int) -> dict[str, dict[str, Any]]:
    """Seconds by row and side, and what failed."""
    sides = [("clift", precision) for precision in OURS]
    sides += [("PyTorch", precision) for precision in bench.torch_precisions]
    results: dict[str, dict[str, Any]] = {row.name: {"samples_s": {}, "errors": {}} for row in rows}
    for row in rows:
        result = results[row.name]
        for round_ in range(rounds):
            for side in sides if round_ % 2 == 0 else sides[::-1]:
                name = " ".join(side)
                if name in result["errors"]:
                    continue
                work = bench.measure_clift if side[0] == "clift" else bench.measure_torch
                started = time.monotonic()
                try:
                    samples = work(row, side[1])
                except Failed as error:
                    result["errors"][name] = str(error)
                    print(f"{row.name}, {name}: failed: {error}", file=sys.stderr, flush=True)
                    continue
                result["samples_s"].setdefault(name, []).extend(samples)
                took = time.monotonic() - started
                print(f"{row.name}, {name}: {seconds(statistics.median(samples))} ({took:.0f} s in all)", flush=True)
    return results


def medians(result: dict[str, Any]) -> dict[str, float]:
    return {side: statistics.median(samples) for side, samples in result["samples_s"].items() if samples}


def seconds(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f} s" if value >= 1 else f"{value * 1e3:.3g} ms"


def table(results: dict[str, dict[str, Any]], torch_precisions: tuple[str, ...]) -> str:
    """Seconds of every side, and ours over PyTorch's: f32 over the first of its precisions, f16 over the second."""
    sides = [f"clift {precision}" for precision in OURS] + [f"PyTorch {precision}" for precision in torch_precisions]
    pairs = list(zip(sides[: len(OURS)], sides[len(OURS) :]))
    head = ["work", *sides, *(f"{ours} / {theirs}" for ours, theirs in pairs)]
    lines = [head, ["---"] * len(head)]
    for name, result in results.items():
        found = medians(result)
        cells = ["failed" if side in result["errors"] else seconds(found.get(side)) for side in sides]
        ratios = [f"{found[a] / found[b]:.2f}" if a in found and b in found else "-" for a, b in pairs]
        lines.append([name, *cells, *ratios])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def precision_table(rows: list[dict[str, Any]]) -> str:
    lines = [["work", "f16 / f32", "error", "loss f32, f16", "PSNR to f32"], ["---"] * 5]
    for row in rows:
        loss = ", ".join(f"{value:.6f}" for value in row["loss"]) if row.get("loss") else "-"
        psnr = f"{row['psnr_to_f32']:.1f} dB" if row.get("psnr_to_f32") is not None else "-"
        lines.append([row["case"], f"{row['ratio']:.2f}", f"{row['error']:.1e}", loss, psnr])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clift", type=Path, required=True, metavar="EXE", help="built with --features wgpu")
    parser.add_argument("--config", type=Path, default=HERE.parents[1] / "configs" / "tiny.toml", help="sizes are set over it")
    parser.add_argument("--device", default="wgpu", help="clift's: wgpu, or flex for a look")
    parser.add_argument("--python", type=Path, default=Path(sys.executable), metavar="EXE", help="one that has PyTorch")
    parser.add_argument("--torch-device", metavar="NAME", help="cuda, cuda:1, mps or cpu; the first there is by default")
    parser.add_argument("--no-torch", action="store_true", help="measure clift alone")
    parser.add_argument("--tiny", action="store_true", help="64 tokens, two counts, one round: does it run?")
    parser.add_argument("--batch", type=int, default=4, help="scenes of an update")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=5, help="timed repetitions of each process")
    parser.add_argument("--warmup", type=int, default=3, help="repetitions before those, which compile kernels")
    parser.add_argument("--work", help="rows alone, with commas: encode render stage1_step stage2_step")
    parser.add_argument("--limit", type=float, default=1800.0, metavar="S", help="seconds that one process may take")
    parser.add_argument("--json", type=Path, metavar="F", help="write everything that was measured")
    args = parser.parse_args()
    if min(args.rounds, args.repeats, args.batch) < 1 or args.warmup < 0:
        parser.error("rounds, repeats and batch are at least 1, warmup at least 0")
    for path in (args.clift, args.config):
        if not path.exists():
            parser.error(f"{path} does not exist")
    return args


def main() -> int:
    args = parse_arguments()
    args.clift = args.clift.absolute()
    size, counts = FULL | {"batch": args.batch}, RENDER_TOKENS
    if args.tiny:
        size, counts = SMOKE, (16, 64)
        args.rounds, args.repeats, args.warmup = 1, min(args.repeats, 2), min(args.warmup, 1)
    rows = [Row("encode"), *(Row("render", count) for count in counts), Row("stage1_step"), Row("stage2_step")]
    if args.work:
        rows = [row for row in rows if row.work in args.work.split(",")]
    report: dict[str, Any] = {"size": size, "rounds": args.rounds, "repeats": args.repeats, "warmup": args.warmup}
    try:
        report["doctor"] = run([str(args.clift), "doctor"], args.limit)
    except Failed as error:
        report["doctor"] = f"failed: {error}"
    print(report["doctor"], flush=True)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(args, size, Path(folder))
        report["torch"] = bench.torch
        print(f"PyTorch: {bench.torch if isinstance(bench.torch, str) else ', '.join(bench.torch.values())}", flush=True)
        report["rows"] = measure(bench, rows, args.rounds)
        report["half"] = bench.precision()
    for result in report["rows"].values():
        result["median_s"] = medians(result)
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n")
    what = "64 tokens: the figures say nothing" if args.tiny else f"paper's network, updates of {args.batch} scenes"
    print(f"\n{what}; clift on {args.device}; {args.rounds} x {args.repeats} samples, medians\n")
    print(table(report["rows"], bench.torch_precisions))
    if isinstance(bench.torch, str):
        print(f"\nPyTorch was {bench.torch}: no ratios.")
    print("\nWhat f16 products change:\n")
    print(precision_table(report["half"]) if isinstance(report["half"], list) else f"nothing measured: {report['half']}")
    failed = [error for result in report["rows"].values() for error in result["errors"].values()]
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
