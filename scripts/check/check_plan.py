"""Compares the memory that `clift plan` counts with a measured run.

    python3 scripts/check/check_plan.py configs/tiny.toml --steps 120 --scenes 40 --set ..

Plans, runs the parts one after the other in processes of their own, and prints a table of their peak resident memory.
"""

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path


def plan(clift: str, arguments: list[str], folder: Path) -> dict[str, dict]:
    """The parts of a plan by name."""
    path = folder / "plan.json"
    subprocess.run([clift, "plan", *arguments, "--json", path, "--force"], check=True, stdout=subprocess.DEVNULL)
    return {part["part"]: part for part in json.loads(path.read_text())["parts"]}


def measured(command: list[str]) -> int:
    """Peak resident bytes of a process.

    Read from /proc while it runs: what some kernels report at the end of a process with several threads is a third of it.
    """
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
    return max(peak, usage.ru_maxrss) * 1024


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
        planned = plan(options.clift, arguments, folder)
        peaks = {}
        for part in ["stage1", "clusters", "stage2"]:
            peaks[part] = measured([options.clift, "train", *arguments, "--only", part])
        peaks["eval"] = measured([options.clift, "eval", str(run), "--force"])

    print("| part | memory planned | measured | ratio |")
    print("|---|---|---|---|")
    for part, peak in peaks.items():
        bytes_ = planned[part]["peak_bytes"]
        print(f"| {part} | {bytes_ / 1e6:.0f} MB | {peak / 1e6:.0f} MB | {bytes_ / peak:.2f} |")


if __name__ == "__main__":
    main()
