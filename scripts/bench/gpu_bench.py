"""The sweep of a GPU: clift's kernels and whole updates beside PyTorch, within a few minutes. gpu_bench.sh packs and runs it.

Five parts: `clift doctor`; every candidate tile of the products and attentions (crates/clift-cube/examples/sweep); updates,
encoding and rendering of the paper's network beside PyTorch (the twin in clift_torch.py, with fused attention and AdamW);
the time of every kernel in them (`clift bench --ledger`); steps of configs/re10k.toml. Every measurement is a process of its own with a time limit, and is in the JSON file as soon
as it ends (candidates: as soon as each ends). The time that a part leaves is for the next ones. `clift` compiles kernels to
WGSL, without cooperative matrices; `clift-spirv`, if packed, to SPIR-V, with them.

Needs Python 3.11. PyTorch is looked for in the Python that `--python` names, by default this one.

Exit codes: 0 done, 1 something failed or was not measured, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from bench_rows import FULL, SMOKE, overrides

HERE = Path(__file__).resolve().parent
PACKED = HERE.parent
# Parts, and the share of the time at which each ends at the latest.
PARTS = {"doctor": 0.12, "kernels": 0.45, "updates": 0.75, "ledger": 0.83, "train": 0.97}
# Repeats of every work. The first half warms up: a GPU raises its clocks only under load.
WORKS = {"stage1_step": 10, "stage2_step": 14, "encode": 120, "render": 120}
# A candidate that takes longer is stopped. The first update of a process compiles all kernels.
CANDIDATE_S = 20.0
# Failures in a row after which a compiler is given up: the device or the driver does not work.
MAX_FAILURES = 5
STEPS = 50
# The time of the first use includes compiling in every process: drivers keep nothing on disk.
NO_SHADER_CACHE = {"__GL_SHADER_DISK_CACHE": "0", "MESA_SHADER_CACHE_DISABLE": "true"}
# The precision of training.
PRECISION = {"SPIR-V": "f16", "WGSL": "f32"}

Values = dict[str, Any]


class Failed(Exception):
    """A process that did not do what it was asked."""

    def __init__(self, reason: str, output: str = ""):
        super().__init__(reason)
        self.output = output


def run(command: list[Any], limit_s: float, poll: Callable[[str, bool], bool] = lambda *_: True) -> str:
    """Returns what a process prints. `poll` is called several times a second with that and whether the process runs, and
    stops it by False.

    A process that cannot be killed (inside the driver) is left behind.
    """
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        try:
            process = subprocess.Popen([str(word) for word in command], stdout=out, stderr=err, start_new_session=True)
        except OSError as error:
            raise Failed(str(error)) from None
        end = time.monotonic() + limit_s
        failure = None
        while failure is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.2)
            if not poll(read(out), process.returncode is None):
                failure = "hangs"
            elif process.returncode is not None:
                break
            elif time.monotonic() > end:
                failure = f"not done after {limit_s:.0f} s"
        if failure is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(5)
        elif process.returncode != 0:
            words = ["", *read(err).strip().splitlines()]
            failure = f"exit code {process.returncode}: {words[-1][:300]}"
        output = read(out)
    if failure is not None:
        raise Failed(failure, output)
    return output


def read(file: Any) -> str:
    # Not through the file object: the process shares its position.
    size = os.fstat(file.fileno()).st_size
    return os.pread(file.fileno(), size, 0).decode(errors="replace")


class Sweep:
    """The report, and what every part needs."""

    def __init__(self, args: argparse.Namespace, folder: Path):
        self.args, self.folder = args, folder
        self.start = time.monotonic()
        self.size = SMOKE if args.tiny else FULL | {"batch": 4}
        self.report: Values = {"size": self.size, "minutes": args.minutes, "gpu": gpu("name,driver_version")}
        self.failed = False

    def save(self) -> None:
        self.report["seconds"] = round(time.monotonic() - self.start, 1)
        new = self.args.json.with_suffix(".new")
        new.write_text(json.dumps(self.report, indent=1) + "\n")
        new.replace(self.args.json)

    def left(self, share: float) -> float:
        """Seconds until a share of the time."""
        return self.start + self.args.minutes * 60 * share - time.monotonic()

    def say(self, text: str) -> None:
        print(f"{time.monotonic() - self.start:4.0f} s  {text}", flush=True)

    def fail(self, what: str, error: Failed | str) -> str:
        self.failed = True
        self.say(f"{what}: {error}")
        return str(error)

    def binaries(self) -> Iterator[tuple[str, Path]]:
        for compiler, path in (("SPIR-V", PACKED / "clift-spirv"), ("WGSL", PACKED / "clift")):
            if path.exists():
                yield compiler, path

    # ------------------------------------------------------------- the parts

    def doctor(self, end: float) -> None:
        results = self.report["doctor"] = {}
        for compiler, clift in self.binaries():
            try:
                results[compiler] = run([clift, "doctor"], self.left(end) * (0.6 if not results else 1.0))
            except Failed as error:
                results[compiler] = f"{error.output}\n{self.fail(f'doctor, {compiler}', error)}"
            self.save()

    def kernels(self, end: float) -> None:
        now = 1 - self.left(1.0) / (self.args.minutes * 60)
        for compiler, end_ in (("spirv", now + 0.7 * (end - now)), ("wgsl", end)):
            rows = self.report.setdefault("kernels", {})[compiler] = []
            first = failures = 0
            while failures < MAX_FAILURES and self.left(end_) > 2:
                done = len(rows)
                error = self.candidates(compiler, first, rows, self.left(end_))
                if error is None:
                    break
                if rows and rows[-1].get("state") == "starts":
                    del rows[-1]["state"]
                    rows[-1]["failed"] = error if self.left(end_) > 0 else "the time was over"
                failures = 1 if len(rows) > done + 1 else failures + 1
                if len(rows) == done:
                    self.fail(f"kernels, {compiler}", error)
                    break
                first = rows[-1]["index"] + 1
                self.say(f"kernel {rows[-1]['index']}, {compiler}: {rows[-1].get('failed', error)[:160]}")
            self.say(f"kernels, {compiler}: {len(rows)} candidates")
            self.save()

    def candidates(self, compiler: str, first: int, rows: list[Values], limit_s: float) -> str | None:
        """Runs the candidates from `first` in one process; returns why it ended before the last one."""
        done, seen, since = len(rows), 0, time.monotonic()

        def poll(output: str, _runs: bool) -> bool:
            nonlocal seen, since
            lines = output[: output.rfind("\n") + 1].splitlines()
            if len(lines) > seen:
                seen, since = len(lines), time.monotonic()
                objects = [json.loads(line) for line in lines if line.startswith("{")]
                self.report |= {f"adapter, {compiler}": one for one in objects if "adapter" in one}
                # The results of a candidate replace its start.
                rows[done:] = {one["index"]: one for one in objects if "index" in one}.values()
                self.save()
            return time.monotonic() - since < CANDIDATE_S * (3 if self.args.tiny else 1)

        size = "tiny" if self.args.tiny else "full"
        try:
            run([PACKED / "sweep", compiler, size, first], limit_s, poll)
        except Failed as error:
            return str(error)
        return None

    def torch_process(self, spec: Values, limit_s: float) -> Values:
        spec = {"threads": os.cpu_count() or 1, **spec}
        return json.loads(run([self.args.python, HERE / "torch_cases.py", json.dumps(spec)], limit_s))

    def updates(self, end: float) -> None:
        rows = self.report["updates"] = []
        try:
            torch = self.torch_process({"work": "where", "device": None}, min(60.0, self.left(end)))
            self.report["torch"] = torch
        except Failed as error:
            torch, self.report["torch"] = None, self.fail("PyTorch", error)
        # The most valuable first.
        clifts = {compiler: path for compiler, path in self.binaries()}
        sides = [("SPIR-V", "f16"), ("torch", "bf16"), ("WGSL", "f32"), ("torch", "tf32"), ("SPIR-V", "f32")]
        for work in WORKS:
            for side, precision in sides:
                if side not in clifts and (side != "torch" or torch is None):
                    continue
                name = f"{'PyTorch' if side == 'torch' else f'clift {side}'} {precision}"
                row: Values = {"work": work, "side": name}
                rows.append(row)
                limit_s, began = self.left(end) * 0.6, time.monotonic()
                try:
                    if limit_s < 3:
                        raise Failed("no time was left")
                    if side == "torch":
                        samples = self.measure_torch(work, precision, torch["device"], limit_s)
                    else:
                        samples = self.measure_clift(clifts[side], work, precision, limit_s)
                    median = statistics.median(samples[len(samples) // 2 :])
                    row |= {"first_s": samples[0], "median_s": median, "samples_s": samples}
                    self.say(f"{work}, {name}: {seconds(median)}, the first {seconds(samples[0])}")
                except Failed as error:
                    row["failed"] = self.fail(f"{work}, {name}", error)
                row["process_s"] = round(time.monotonic() - began, 1)
                self.save()

    def measure_torch(self, work: str, precision: str, device: str, limit_s: float) -> list[float]:
        variant = {"stage2_step": "exact sdpa"}.get(work, "sdpa")
        spec = dict(work=work, variant=variant, size=self.size, precision=precision, device=device)
        return self.torch_process(spec | dict(repeats=WORKS[work], warmup=0), limit_s)["samples_s"]

    def measure_clift(self, clift: Path, work: str, precision: str, limit_s: float) -> list[float]:
        path = self.folder / "clift.json"
        command = [clift, "bench", PACKED / "sizes.toml", "--case", work, "--no-error", "--stored-tokens", "1/4"]
        command += ["--repeats", WORKS[work], "--warmup", 0, "--json", path, "--force", "--device", self.args.device]
        run([*command, *sets(*overrides(self.size), f'precision="{precision}"')], limit_s)
        written = json.loads(path.read_text())
        if written["precision"] != precision or written["device"] != self.args.device:
            raise Failed(f"clift measured {written['device']} in {written['precision']}")
        return written["rows"][0]["samples_s"]

    def ledger(self, end: float) -> None:
        """The kernels of every work, by the first binary."""
        name, clift = next(self.binaries())
        path = self.folder / "ledger.json"
        command = [clift, "bench", PACKED / "sizes.toml", "--ledger", "--case", ",".join(WORKS), "--stored-tokens", "1/4"]
        command += ["--json", path, "--force", "--device", self.args.device]
        try:
            run([*command, *sets(*overrides(self.size), f'precision="{PRECISION[name]}"')], self.left(end))
            self.report["ledger"] = json.loads(path.read_text())
        except Failed as error:
            self.fail("ledger", error)
        self.save()

    def train(self, end: float) -> None:
        """Steps of re10k.toml with one micro-batch of four scenes each, by the first binary whose updates work."""
        clifts = [(f"clift {compiler} {PRECISION[compiler]}", compiler, path) for compiler, path in self.binaries()]
        updates = [row for row in self.report.get("updates", []) if row["work"] == "stage1_step"]
        broken = [row["side"] for row in updates if "failed" in row]
        name, compiler, clift = next((one for one in clifts if one[0] not in broken), clifts[-1])
        keys = [f'run_dir="{self.folder / "run"}"', f'precision="{PRECISION[compiler]}"', f"stage1.steps={STEPS}"]
        keys += ["stage1.batch_size=4", "stage1.accumulate=1", "loss.perceptual_weight=0.0"]
        # Short clips are enough.
        keys += ["data.filters.min_frames=16", "data.views.min_gap=[9,9]", "data.views.max_gap=[45,45]"]
        data = PACKED / "data"
        if data.exists():
            keys += [f'data.root="{data}"']
        else:
            keys += ['data.source="synthetic"', "data.synthetic.width=256", "data.synthetic.height=256"]
            keys += ["data.synthetic.num_frames=48"]
        keys += TINY_TRAINING if self.args.tiny else []
        memory = {"before": gpu_bytes()}
        row: Values = {"clift": name, "data": "chunks" if data.exists() else "synthetic", "gpu_bytes": memory}
        self.report["train"] = row
        metrics, steps = self.folder / "run" / "metrics.jsonl", []
        began = time.monotonic()

        def poll(_output: str, runs: bool) -> bool:
            lines = metrics.read_text().split("\n")[:-1] if metrics.exists() else []
            if len(lines) > len(steps):
                steps[:] = [json.loads(line) for line in lines]
                row.setdefault("seconds_to_first_step", round(time.monotonic() - began, 1))
                if runs and len(steps) // 10 >= len(memory):
                    memory[f"after step {len(steps)}"] = gpu_bytes()
                row["step_s"] = [step["step_s"] for step in steps]
                row["loss"] = [step["loss"] for step in steps]
                row["host_bytes"] = {i: steps[i - 1]["peak_bytes"] for i in (10, STEPS) if i <= len(steps)}
                self.save()
            return True

        command = [clift, "train", PACKED / "re10k.toml", "--only", "stage1", "--device", self.args.device]
        try:
            run([*command, *sets(*keys)], self.left(end), poll)
        except Failed as error:
            row["failed"] = self.fail("train", error)
        self.save()


TINY_TRAINING = ["model.dim=64", "model.num_heads=4", "model.feed_forward_dim=96", "model.num_encoder_blocks=1"]
TINY_TRAINING += ["model.num_renderer_blocks=1", "data.width=64", "data.height=64", "data.views.num_targets=1"]


def sets(*keys: str) -> list[str]:
    return [word for key in keys for word in ("--set", key)]


def gpu(query: str) -> str | None:
    """What nvidia-smi reports of the first GPU."""
    try:
        return run(["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader,nounits"], 5).split("\n")[0].strip()
    except Failed:
        return None


def gpu_bytes() -> int | None:
    """Memory of the GPU that is in use, by all processes."""
    mebibytes = gpu("memory.used")
    return int(mebibytes) << 20 if mebibytes and mebibytes.isdigit() else None


# ------------------------------------------------------------------ tables


def seconds(value: float) -> str:
    return f"{value:.2f} s" if value >= 1 else f"{value * 1e3:.3g} ms"


def table(head: list[str], lines: list[list[str]]) -> str:
    return "\n".join("|" + "|".join(line) + "|" for line in [head, ["---"] * len(head), *lines])


def is_wrong(row: Values) -> bool:
    """Whether an error is larger than that of rounding, to f16 where operands are."""
    limit = 1e-2 if "planes" in row["tile"] or "f16" in row["kernel"] else 1e-4
    return row["error"] is None or row["error"] > limit


def kernel_table(compilers: dict[str, list[Values]]) -> str:
    """The fastest right candidate of every kernel and shape; with WGSL its times alone."""
    groups: dict[tuple[str, str, bool], dict[str, list[Values]]] = {}
    for compiler, rows in compilers.items():
        for row in rows:
            key = (row["kernel"], row["case"], "planes" in row["tile"])
            groups.setdefault(key, {}).setdefault(compiler, []).append(row)
    lines = []
    for (kernel, case, _), group in groups.items():
        line = [kernel, case]
        for compiler in ("spirv", "wgsl"):
            rows = group.get(compiler, [])
            measured = [row for row in rows if "ms" in row]
            right = [row for row in measured if not is_wrong(row)]
            counts = f"{len(right)}/{len(rows)}" if rows else "-"
            counts += f" {len(measured) - len(right)} WRONG" if len(measured) > len(right) else ""
            cells = ["-"] * 5
            if right:
                best = min(right, key=lambda row: row["ms"])
                rate = f"{best['rate']:.3g} {best['unit']}"
                cells = [best["tile"], f"{best['ms']:.3g}", rate, f"{best['error']:.0e}", f"{best['first_ms'] / 1e3:.1f}"]
            line += [*cells, counts] if compiler == "spirv" else [cells[1], cells[4], counts]
        lines.append(line)
    head = ["kernel", "shape", "tile, SPIR-V", "ms", "rate", "error", "first, s", "right"]
    return table([*head, "ms, WGSL", "first, s", "right"], lines)


def update_table(rows: list[Values]) -> str:
    sides = list(dict.fromkeys(row["side"] for row in rows))
    lines = []
    for work in dict.fromkeys(row["work"] for row in rows):
        done = [row for row in rows if row["work"] == work and "median_s" in row]
        text = {row["side"]: f"{seconds(row['median_s'])} ({seconds(row['first_s'])})" for row in done}
        lines.append([work, *(text.get(side, "failed") for side in sides)])
    return table(["work: median (first)", *sides], lines)


def ledger_table(ledger: Values) -> str:
    """The kernels of every work that take the most time."""
    lines = []
    for row in ledger["rows"]:
        kernels = sorted(row["kernels"], key=lambda kernel: -(kernel["seconds"] or 0))
        for kernel in kernels[:8]:
            time_s, size = kernel["seconds"], kernel["bytes"]
            cells = [seconds(time_s) if time_s else "-", f"{size / 1e9:.3g}" if size else "-"]
            lines.append([row["case"], kernel["kernel"], str(kernel["count"]), *cells])
        total = sum(kernel["count"] for kernel in row["kernels"])
        held = row["reserved_bytes"] or 0
        lines.append([row["case"], "all", str(total), f"{held / 2**30:.2f} GiB held", ""])
    return table(["work", "kernel", "launches", "time", "GB"], lines)


def train_text(row: Values) -> str:
    if "step_s" not in row:
        return f"{row['clift']}, {row['data']}: no step was done"
    steps = row["step_s"]
    later = f", then {len(steps[1:]) / sum(steps[1:]):.3g} steps/s" if steps[1:] else ""
    memory = ", ".join(f"{name} {value / 2**30:.2f}" for name, value in row["gpu_bytes"].items() if value is not None)
    host = ", ".join(f"after step {name} {value / 2**30:.2f}" for name, value in row["host_bytes"].items() if value)
    return (
        f"{row['clift']}, {row['data']}: {len(steps)} steps, the first {seconds(steps[0])} "
        f"({row['seconds_to_first_step']} s after the start of the process){later}; loss {row['loss'][0]:.4f} to "
        f"{row['loss'][-1]:.4f}; GiB on the GPU: {memory or 'unknown'}; peak of the host: {host or 'unknown'}"
    )


def summary(report: Values) -> str:
    parts = []
    for compiler, text in report.get("doctor", {}).items():
        rows = [line for line in text.splitlines() if line.startswith(("wgpu", "flex", "device"))]
        parts.append(f"clift doctor, {compiler}:\n" + "\n".join(rows or [text.strip()[-300:]]))
    if any(report.get("kernels", {}).values()):
        parts.append(kernel_table(report["kernels"]))
    if report.get("updates"):
        parts.append(update_table(report["updates"]))
    if "ledger" in report:
        parts.append(ledger_table(report["ledger"]))
    if "train" in report:
        parts.append(train_text(report["train"]))
    return "\n\n".join(parts)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=6.0, help="limit of all parts together")
    parser.add_argument("--parts", default=",".join(PARTS), help="parts to run, with commas; their time is shared")
    parser.add_argument("--json", type=Path, default=Path("gpu.json"), metavar="F", help="file of all measurements")
    parser.add_argument("--tiny", action="store_true", help="small sizes: does everything run?")
    parser.add_argument("--device", default="wgpu", help="clift's, for updates and training: wgpu, or flex for a look")
    parser.add_argument("--python", default=sys.executable, metavar="EXE", help="one that has PyTorch")
    args = parser.parse_args()
    args.parts = args.parts.split(",")
    if not set(args.parts) <= set(PARTS):
        parser.error(f"the parts are {', '.join(PARTS)}")
    return args


def main() -> int:
    args = parse_arguments()
    os.environ |= NO_SHADER_CACHE
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        sweep = Sweep(args, Path(folder))
        for part, end in PARTS.items():
            if part in args.parts:
                sweep.say(part)
                try:
                    getattr(sweep, part)(end if part != args.parts[-1] else PARTS["train"])
                except Exception as error:  # costs only this part
                    sweep.report[part + " failed"] = sweep.fail(part, repr(error))
                sweep.save()
    print(f"\n{summary(sweep.report)}\n\n{args.json}: {args.json.stat().st_size / 1e3:.0f} kB")
    return 1 if sweep.failed else 0


if __name__ == "__main__":
    sys.exit(main())
