"""Compares clift with PyTorch: the same work, alternately, on a quiet Linux machine's CPU, in f32 and in bf16.

    python3 scripts/bench/bench_pytorch.py --size smoke                          # does it run? seconds, no judgement
    python3 scripts/bench/bench_pytorch.py --targets --json bench.json           # the full sizes
    python3 scripts/bench/bench_pytorch.py --work stage1_step,render --rounds 3

Needs Python 3.11 and nothing else: it makes its own virtual environment from scripts/requirements.txt and builds
clift, unless `--python` and `--clift` name what there is.

A round starts one process of each side, in turn the other way round, with the same number of threads; a process does
one piece of work only, and its peak memory is read from the kernel at its end. PyTorch is the twin (clift_torch.py) on
fused attention, with the faster ways of torch_cases.py; where it has several, all are timed first and the fastest
competes, in bf16 under autocast. Ours is `clift bench`, in bf16 with `precision = "bf16"`. A round in which somebody
else used the processor is thrown away and made again.

Exit codes: 0 done, 1 something failed (or a target was missed, with --strict), 2 wrong usage, 3 the machine is not
quiet, 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import quiet_machine
from bench_rows import SIZES, Row, Side, Torch, overrides, rows
from quiet_machine import CommandFailed, Loaded

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
REQUIREMENTS = ROOT / "scripts" / "requirements.txt"
# CPU builds of torch; the default ones for Linux carry gigabytes of CUDA.
CPU_WHEELS = "https://download.pytorch.org/whl/cpu"
# Repetitions of each way PyTorch has, before the fastest is chosen.
PROBES = 2


# ------------------------------------------------------------ environment


def make_environment(folder: Path) -> Path:
    """A virtual environment with what requirements.txt asks for; made once."""
    python, installed = folder / "bin" / "python", folder / "requirements.txt"
    if installed.exists() and installed.read_text() == REQUIREMENTS.read_text():
        return python
    print(f"making {folder} from {REQUIREMENTS.name}", flush=True)
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    wheels = [] if {"PIP_INDEX_URL", "PIP_EXTRA_INDEX_URL"} & os.environ.keys() else ["--extra-index-url", CPU_WHEELS]
    subprocess.run([python, "-m", "pip", "install", "--quiet", *wheels, "-r", REQUIREMENTS], check=True)
    shutil.copyfile(REQUIREMENTS, installed)
    return python


def build_clift() -> Path:
    print("cargo build --release", flush=True)
    subprocess.run(["cargo", "build", "--release"], cwd=ROOT, check=True)
    target = os.environ.get("CARGO_TARGET_DIR", "target")
    return ROOT / target / "release" / "clift"


def one_line(command: list[str]) -> str | None:
    """What a command prints, or None where it fails."""
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


# ------------------------------------------------------------ measurements


@dataclass
class Measured:
    """One process: its timed repetitions and its memory."""

    samples: list[float]
    peak_bytes: int
    foreign_cores: float
    wall_s: float


class Bench:
    """Runs single measurements of either side."""

    def __init__(self, args: argparse.Namespace, python: Path, clift: Path | None, folder: Path):
        self.args, self.python, self.clift, self.folder = args, python, clift, folder
        self.env = {name: str(args.threads) for name in ("RAYON_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        self.seconds_lost = 0.0
        self.probed: dict[tuple[str, str | None, str], float] = {}
        # What a PyTorch process holds that does nothing.
        self.baseline_bytes = 0

    def command(self, side: Side, round_: int | None, variant: str | None) -> list[str]:
        if isinstance(side, Torch):
            return self.worker(self.torch_spec(side, round_, variant))
        size = dict(SIZES[side.size or self.args.size])
        # The first step has no optimiser state yet while it goes backward: the second one's memory counts.
        repeats, warmup = (1, 1) if side.contexts else (self.args.repeats, self.args.warmup)
        command = [str(self.clift), "bench", str(self.args.config), "--case", side.work, "--device", "flex"]
        command += ["--no-error", "--repeats", str(repeats), "--warmup", str(warmup), "--stored-tokens", "1/4"]
        size |= {"contexts": side.contexts} if side.contexts else {}
        for override in [*overrides(size, side.is_lvsm), *side.overrides]:
            command += ["--set", override]
        command += ["--set", f"seed={round_}", "--json", str(self.folder / "ours.json"), "--force"]
        return command

    def worker(self, spec: dict[str, Any]) -> list[str]:
        return [str(self.python), str(HERE / "torch_cases.py"), json.dumps({"threads": self.args.threads, **spec})]

    def torch_spec(self, side: Torch, round_: int | None, variant: str | None) -> dict[str, Any]:
        spec = dict(work=side.work, variant=variant, size=SIZES[side.size or self.args.size], precision=side.precision)
        repeats = PROBES if round_ is None else self.args.repeats
        spec |= dict(repeats=repeats, warmup=self.args.warmup)
        return spec

    def measure(self, side: Side, round_: int | None, variant: str | None = None) -> Measured:
        command = self.command(side, round_, variant)
        finished = quiet_machine.run(command, self.env)
        written: dict[str, Any] = {}
        if isinstance(side, Torch):
            found = json.loads(finished.stdout)
        else:
            written = json.loads((self.folder / "ours.json").read_text())
            found = next((row for row in written["rows"] if row["case"] == side.work), None)
            if found is None:
                raise CommandFailed(f"no row `{side.work}` in the JSON of `{' '.join(command)}`")
            if written.get("threads", self.args.threads) != self.args.threads:
                raise CommandFailed(f"clift used {written['threads']} threads instead of {self.args.threads}")
        return Measured(found["samples_s"], finished.peak_bytes, finished.foreign_cores, finished.wall_s)

    def wait(self) -> None:
        if not self.args.force:
            quiet_machine.wait_until_quiet(self.args.max_busy, self.args.wait)

    def fastest_variant(self, side: Torch, variants: list[str]) -> tuple[str | None, dict[str, float]]:
        """The variant that takes the least time, and the times of all."""
        if len(variants) < 2:
            return (variants[0] if variants else None), {}
        times = {}
        for variant in variants:
            # Rows that differ in the variants they allow do the same thing in those they share.
            key = (side.work.removesuffix("_unshared"), side.size, f"{side.precision} {variant}")
            if key not in self.probed:
                self.wait()
                try:
                    self.probed[key] = min(self.measure(side, None, variant).samples)
                except CommandFailed as error:
                    # One way may need what is missing here: torch.compile needs a C++ compiler.
                    print(f"  PyTorch {side.precision}, {variant}: failed: {str(error).strip().splitlines()[-1]}", flush=True)
                    continue
                print(f"  PyTorch {side.precision}, {variant}: {seconds(self.probed[key])}", flush=True)
            times[variant] = self.probed[key]
        return (min(times, key=times.__getitem__) if times else variants[0]), times

    def round(self, sides: list[Side], chosen: dict[Side, str | None], round_: int) -> dict[Side, Measured | str]:
        """Measures all sides once, again and again until nobody disturbs. A side that fails gives its error."""
        order = sides if round_ % 2 == 0 else sides[::-1]
        while True:
            self.wait()
            found: dict[Side, Measured | str] = {}
            for side in order:
                try:
                    found[side] = self.measure(side, round_, chosen.get(side))
                except CommandFailed as error:
                    print(f"  failed: {error}", file=sys.stderr, flush=True)
                    found[side] = str(error)
            measured = [one for one in found.values() if isinstance(one, Measured)]
            foreign = max((one.foreign_cores for one in measured), default=0.0)
            if self.args.force or foreign <= self.args.max_busy:
                return found
            self.seconds_lost += sum(one.wall_s for one in measured)
            sentence = f"others kept {foreign:.2f} cores busy during a round"
            if self.seconds_lost > self.args.wait:
                raise Loaded(f"{sentence}; {self.seconds_lost:.0f} s of measurements thrown away so far")
            print(f"  again: {sentence}", flush=True)


def run_group(bench: Bench, group: list[Row], variants: dict[str, list[str]]) -> list[dict[str, Any]]:
    """All rounds of rows that share measurements."""
    sides: list[Side] = list(dict.fromkeys(side for row in group for side in (row.ours, row.torch) if side))
    if bench.clift is None:
        sides = [side for side in sides if isinstance(side, Torch)]
    chosen, variant_times = {}, {}
    for side in sides:
        if isinstance(side, Torch):
            chosen[side], variant_times[side] = bench.fastest_variant(side, variants.get(side.work, []))
    rounds: list[dict[Side, Measured]] = []
    errors: dict[Side, str] = {}
    for round_ in range(1 if group[0].torch is None else bench.args.rounds):
        found = bench.round([side for side in sides if side not in errors], chosen, round_)
        errors |= {side: one for side, one in found.items() if isinstance(one, str)}
        rounds.append({side: one for side, one in found.items() if isinstance(one, Measured)})
        times = ", ".join(f"{describe(side)} {seconds(statistics.median(m.samples))}" for side, m in rounds[-1].items())
        print(f"  round {round_ + 1}: {times}", flush=True)
    results = []
    for row in group:
        problems = [errors[side] for side in (row.ours, row.torch) if side in errors]
        if problems:
            results.append({"work": row.work, "error": "\n".join(problems)})
            continue
        result = summarise(row, rounds, bench.baseline_bytes)
        if row.torch in chosen:
            result["pytorch_variant"] = chosen[row.torch]
            result["pytorch_variants_s"] = variant_times[row.torch]
        results.append(result)
    return results


def describe(side: Side) -> str:
    name = f"PyTorch {side.precision}" if isinstance(side, Torch) else " ".join(["clift", *side.overrides])
    return f"{name} {side.work}"


def summarise(row: Row, rounds: list[dict[Side, Measured]], baseline_bytes: int) -> dict[str, Any]:
    """Medians over all repetitions; the spread is over the rounds."""
    result: dict[str, Any] = {"work": row.work}
    for name, side in (("ours", row.ours), ("pytorch", row.torch)):
        measured = [found[side] for found in rounds if side in found]
        samples = [sample for one in measured for sample in one.samples]
        result[f"{name}_s"] = statistics.median(samples) if samples else None
        result[f"{name}_min_max_s"] = [min(samples), max(samples)] if samples else None
        result[f"{name}_bytes"] = int(statistics.median(one.peak_bytes for one in measured)) if measured else None
        result[f"{name}_samples_s"] = [one.samples for one in measured]
    result["foreign_cores"] = max(one.foreign_cores for found in rounds for one in found.values())
    if result["ours_s"] and result["pytorch_s"]:
        ratios = [
            statistics.median(found[row.ours].samples) / statistics.median(found[row.torch].samples) for found in rounds
        ]
        result["ratio"] = result["ours_s"] / result["pytorch_s"]
        result["ratio_rounds"], result["ratio_spread"] = ratios, [min(ratios), max(ratios)]
        result["memory_ratio"] = result["ours_bytes"] / result["pytorch_bytes"]
        grown = result["pytorch_bytes"] - baseline_bytes
        result["memory_ratio_less_import"] = result["ours_bytes"] / grown if grown > 0 else None
    return result


def judge(row: Row, result: dict[str, Any], size: str) -> None:
    """Adds the targets and whether they are met. They are for the full sizes."""
    if size != "full":
        return
    result["targets"] = {
        name: {"at_most": most, "met": result[name] <= most}
        for name, most in row.targets
        if result.get(name) is not None
    }


# ------------------------------------------------------------------- table


def seconds(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f} s" if value >= 10 else f"{value:.3f} s" if value >= 1 else f"{value * 1e3:.3g} ms"


def gigabytes(value: int | None) -> str:
    return "-" if value is None else f"{value / 1e9:.2f} GB"


def table(results: list[dict[str, Any]], targets: bool) -> str:
    head = ["work", "ours", "PyTorch", "ratio (rounds)", "ours", "PyTorch", "ratio"]
    head += ["target"] * targets
    lines = [head, ["---"] * len(head)]
    for result in results:
        if "error" in result:
            lines.append([result["work"], "failed"] + ["-"] * (len(head) - 2))
            continue
        ratio = "-"
        if "ratio" in result:
            low, high = result["ratio_spread"]
            ratio = f"{result['ratio']:.3f} ({low:.3f} .. {high:.3f})"
        memory = f"{result['memory_ratio']:.2f}" if "memory_ratio" in result else "-"
        line = [result["work"], seconds(result["ours_s"]), seconds(result["pytorch_s"]), ratio]
        line += [gigabytes(result["ours_bytes"]), gigabytes(result["pytorch_bytes"]), memory]
        if targets:
            names = {"ratio": "time", "memory_ratio": "memory", "ours_bytes": "bytes"}
            texts = []
            for name, target in result.get("targets", {}).items():
                most, verdict = target["at_most"], "met" if target["met"] else "**missed**"
                texts.append(f"{names[name]} <= {gigabytes(most) if name == 'ours_bytes' else most}: {verdict}")
            line.append("; ".join(texts) or "-")
        lines.append(line)
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


# -------------------------------------------------------------------- main


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=SIZES, default="full")
    parser.add_argument("--work", help="rows to make, with commas: " + " ".join(row.work for row in rows()))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--repeats", type=int, default=5, help="timed repetitions of each process")
    parser.add_argument("--warmup", type=int, default=1, help="repetitions before those")
    parser.add_argument("--threads", type=int, default=quiet_machine.physical_cores(), help="default: physical cores")
    parser.add_argument("--json", type=Path, metavar="F", help="write everything that was measured")
    parser.add_argument("--targets", action="store_true", help="print each target and whether it is met (full size)")
    parser.add_argument("--strict", action="store_true", help="exit with 1 if a target is missed")
    parser.add_argument("--pytorch-only", action="store_true", help="measure PyTorch alone")
    parser.add_argument("--config", type=Path, default=ROOT / "configs" / "tiny.toml", help="sizes are set over it")
    parser.add_argument("--clift", type=Path, metavar="EXE", help="default: cargo build --release")
    parser.add_argument("--python", type=Path, metavar="EXE", help="default: that of --venv")
    parser.add_argument("--venv", type=Path, metavar="DIR", default=ROOT / ".venv-bench")
    parser.add_argument("--max-busy", type=float, default=0.15, help="cores that others may use")
    parser.add_argument("--wait", type=float, default=300.0, help="seconds to wait for quiet, or to throw away")
    parser.add_argument("--force", action="store_true", help="measure on a loaded machine; recorded in the JSON")
    args = parser.parse_args()
    names = [row.work for row in rows()]
    if args.work is None:
        left_out = {"tiny": {"stage1_step_tiny", "growth"}}.get(args.size, set())
        args.work = [name for name in names if name not in left_out]
    else:
        args.work = args.work.split(",")
        for name in set(args.work) - set(names):
            parser.error(f"no work `{name}`; there are {' '.join(names)}")
    if min(args.rounds, args.repeats, args.threads) < 1 or args.warmup < 0:
        parser.error("rounds, repeats and threads are at least 1, warmup at least 0")
    for path in (args.config, args.clift, args.python):
        if path is not None and not path.exists():
            parser.error(f"{path} does not exist")
    return args


def note_load(args: argparse.Namespace, report: dict[str, Any]) -> None:
    """Whether others used the processor during any measurement."""
    foreign = [row["foreign_cores"] for row in report["rows"] if "foreign_cores" in row]
    if foreign:
        report["loaded"] = max(foreign) > args.max_busy


def write_report(args: argparse.Namespace, report: dict[str, Any]) -> None:
    """Writes what there is: also after each group of rows, for a full comparison takes long."""
    note_load(args, report)
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n")


def measure_all(args: argparse.Namespace, folder: Path, report: dict[str, Any]) -> int:
    # Not resolved: a virtual environment's interpreter is a link, and knows its packages by where the link lies.
    python = Path(os.path.abspath(args.python)) if args.python else make_environment(args.venv.absolute())
    clift = None if args.pytorch_only else (args.clift or build_clift()).absolute()
    bench = Bench(args, python, clift, folder)
    try:
        known = json.loads(quiet_machine.run(bench.worker({"work": "versions"}), bench.env).stdout)
    except CommandFailed as error:
        raise CommandFailed(f"{python} cannot do PyTorch's side; does it have {REQUIREMENTS.name}?\n{error}") from None
    quiet_machine.run([str(python), str(HERE / "check_torch_cases.py")], bench.env)
    print("PyTorch's fast ways agree with the twin; its attention is fused", flush=True)
    imports = quiet_machine.run(bench.worker({"work": "import"}), bench.env)
    report["baseline_bytes"] = bench.baseline_bytes = imports.peak_bytes
    report["versions"] = {"python": platform.python_version(), **known["versions"]}
    report["versions"]["clift"] = one_line([str(clift), "--version"]) if clift else None
    report["versions"]["commit"] = one_line(["git", "describe", "--always", "--dirty"])

    selected = [row for row in rows() if row.work in args.work and not (args.pytorch_only and row.torch is None)]
    for name in dict.fromkeys(row.group for row in selected):
        group = [row for row in selected if row.group == name]
        print(", ".join(row.work for row in group), flush=True)
        results = run_group(bench, group, known["variants"])
        for row, result in zip(group, results, strict=True):
            judge(row, result, args.size)
        report["rows"] += results
        write_report(args, report)
    failed = any("error" in result for result in report["rows"])
    missed = any(not target["met"] for result in report["rows"] for target in result.get("targets", {}).values())
    return 1 if failed or (args.strict and missed) else 0


def main() -> int:
    args = parse_arguments()
    # So that a measurement does not go on alone.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    report: dict[str, Any] = {
        "size": args.size,
        "sizes": SIZES[args.size],
        "cpu": quiet_machine.cpu_model(),
        "cores": os.cpu_count(),
        "threads": args.threads,
        "rounds": args.rounds,
        "repeats": args.repeats,
        "warmup": args.warmup,
        "loadavg_at_start": os.getloadavg(),
        "loaded": None,
        "rows": [],
    }
    code = 1
    try:
        busy, sentence = quiet_machine.load()
        report["loaded"] = busy > args.max_busy
        if args.json and not args.json.absolute().parent.is_dir():
            raise CommandFailed(f"there is no folder for {args.json}")
        if args.force and report["loaded"]:
            print(f"the machine is loaded ({sentence}): the figures below say little", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            code = measure_all(args, Path(folder), report)
    except Loaded as error:
        report["stopped"] = str(error)
        print(f"stopped: {error}. Come back when it is quiet, or use --force.", file=sys.stderr)
        code = 3
    except (CommandFailed, subprocess.CalledProcessError, json.JSONDecodeError) as error:
        report["stopped"] = str(error)
        print(f"stopped: {error}", file=sys.stderr)
    except KeyboardInterrupt:
        report["stopped"] = "interrupted"
        code = 130
    note_load(args, report)
    if report["rows"]:
        loaded = "; **others used the processor**" if report["loaded"] else ""
        counts = f"{args.threads} threads, {args.rounds} x {args.repeats} samples"
        print(f"\n{args.size}, {report['cpu']}, {counts}{loaded}\n")
        print(table(report["rows"], args.targets))
        print(f"\nPyTorch's memory holds {gigabytes(report['baseline_bytes'])} that importing it takes.")
    write_report(args, report)
    return code


if __name__ == "__main__":
    sys.exit(main())
