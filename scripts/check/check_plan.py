"""Compares the estimates of `clift plan` with a measured run.

    python3 scripts/check/check_plan.py configs/tiny.toml --steps 120 --scenes 40 --set ..

Plans, runs the parts one after the other in processes of their own, plans again, and prints a table: parameters,
peak resident memory, and seconds per step or scene. Other work on the machine changes the seconds; the two plans
show by how much.
"""

import argparse
import json
import os
import statistics
import subprocess
import tempfile
import time
from pathlib import Path


def plan(clift: str, arguments: list[str], folder: Path) -> dict[str, dict]:
    """The parts of a plan by name."""
    path = folder / "plan.json"
    subprocess.run([clift, "plan", *arguments, "--json", path, "--force"], check=True, stdout=subprocess.DEVNULL)
    return {part["part"]: part for part in json.loads(path.read_text())["parts"]}


def measured(command: list[str]) -> tuple[int, float]:
    """Peak resident bytes and seconds of a process.

    Read from /proc while it runs: what some kernels report at the end of a process with several threads is a third of it.
    """
    started = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    peak = 0
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            break
        try:
            lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
        except OSError:
            lines = []
        peak = max([peak, *(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))])
        time.sleep(0.02)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    return max(peak, usage.ru_maxrss) * 1024, time.monotonic() - started


def step_seconds(run: Path, stage: str) -> float:
    """The fastest tenth of a stage's steps, as a plan takes the fastest of its repetitions."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    steps = sorted(line["step_s"] for line in lines if line["stage"] == stage and line["step"] > 3)
    return steps[len(steps) // 10]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config")
    parser.add_argument("--clift", default="target/release/clift")
    parser.add_argument("--steps", type=int, default=120, help="of each stage")
    parser.add_argument("--scenes", type=int, default=40, help="that are clustered and evaluated")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=TOML")
    options = parser.parse_args()

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run = folder / "run"
        keys = [
            *options.set,
            f'run_dir="{run}"',
            f"stage1.steps={options.steps}",
            "stage1.half_resolution=0",
            f"stage2.steps={options.steps}",
            f"clusters.num_scenes={options.scenes}",
            f"eval.num_scenes={options.scenes}",
            "eval.every=0",
            "eval.num_validation_scenes=1",
            "eval.num_sheets=0",
            "checkpoint.every=0",
        ]
        arguments = [options.config, *(word for key in keys for word in ("--set", key))]
        before = plan(options.clift, arguments, folder)
        results = {}
        for part in ["stage1", "clusters", "stage2"]:
            peak, seconds = measured([options.clift, "train", *arguments, "--only", part])
            results[part] = (peak, seconds / before[part]["count"])
            if part != "clusters":
                steps = [step_seconds(run, part), before[part]["compute_s"]]
                print(f"{part}: the fastest tenth of updates takes {steps[0]:.4g} s, planned {steps[1]:.4g} s")
        peak, seconds = measured([options.clift, "eval", str(run), "--force"])
        results["eval"] = (peak, seconds / options.scenes)
        after = plan(options.clift, arguments, folder)

    print()
    print("| part | memory planned | measured | ratio | seconds planned (before, after) | measured | ratio |")
    print("|---|---|---|---|---|---|---|")
    for part, (peak, seconds) in results.items():
        planned = before[part]["peak_bytes"]
        times = [times[part]["seconds"] for times in (before, after)]
        print(
            f"| {part} | {planned / 1e6:.0f} MB | {peak / 1e6:.0f} MB | {planned / peak:.2f} "
            f"| {times[0]:.4g}, {times[1]:.4g} | {seconds:.4g} | {statistics.mean(times) / seconds:.2f} |"
        )


if __name__ == "__main__":
    main()
