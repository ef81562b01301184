#!/usr/bin/env python3
"""Kills real trainings with SIGKILL at random moments and compares how they end with one that was left alone.

    cargo build --release
    python3 scripts/check/crash_test.py                         # 50 kills, about ten minutes on two cores
    python3 scripts/check/crash_test.py --kills 200 --seed 1

Every other kill waits for a file or folder under a temporary name to appear, that is, for a save, and comes up to a few
milliseconds after it; the others come at a moment uniform over the time of a whole run. Every file of a finished run
must equal that of the undisturbed one, but for times: metrics without `step_s`, the evaluation without its times,
checkpoints by the progress that they hold.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
# Keys of metrics.jsonl and summary.json that differ between equal runs: times, memory, and the Pareto front over times.
TIMES = {"step_s", "images_per_s", "time", "render_s", "select_s", "render_median_s", "render_p95_s", "frame_median_s", "frame_p95_s"}
TIMES |= {"peak_bytes", "pareto_time", "frame_quartiles_s"}

# Small, so that a run takes seconds, and saving all the time.
SETTINGS = [
    "data.synthetic.num_scenes=64",
    "model={dim=48, num_heads=4, feed_forward_dim=64, num_encoder_blocks=1, num_renderer_blocks=1}",
    "stage1={steps=60, batch_size=4, optimizer={learning_rate=1e-3, warm_up_steps=5}}",
    "clusters={grid=['1/4', 1.0], num_passes=2, num_scenes=24}",
    "stage2={steps=50, batch_size=4, optimizer={learning_rate=1e-3, warm_up_steps=5}}",
    "checkpoint={every=2, keep=2}",
    "eval={stored_tokens=['1/4', 1.0], num_scenes=4, every=10, validation_stored_tokens='1/4', num_validation_scenes=2}",
]


def command(clift: Path, run: Path) -> list[str]:
    words = [str(clift), "train", str(ROOT / "configs/tiny.toml")]
    for setting in [f'run_dir="{run}"', *SETTINGS]:
        words += ["--set", setting]
    return words


def stage_of(run: Path) -> str:
    """What the run was doing, by what there is."""
    names = [("eval", "eval/sheets"), ("stage 2", "stage2"), ("clusters", "clusters.tmp"), ("stage 1", "stage1")]
    return next((name for name, path in names if (run / path).exists()), "start")


def saves(run: Path) -> list[str]:
    """Files and folders under a temporary name, but for the cluster cache, which has one all the time."""
    found = [*run.rglob("*.tmp"), *run.rglob(".clift-*")]
    return [str(path.relative_to(run)) for path in found if path.name != "clusters.tmp"]


def wait(child: subprocess.Popen[bytes], run: Path, moment: float, in_save: bool, rng: random.Random) -> None:
    """Returns when it is time to kill, or when the run has ended."""
    end = time.monotonic() + moment
    while child.poll() is None and time.monotonic() < end:
        time.sleep(0.0005)
    while in_save and child.poll() is None and not saves(run):
        pass
    if in_save:
        time.sleep(rng.random() * 0.004)


def without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_times(item) for key, item in value.items() if key not in TIMES}
    return [without_times(item) for item in value] if isinstance(value, list) else value


def result(run: Path) -> dict[str, Any]:
    """Everything a run leaves, but for times."""
    found: dict[str, Any] = {}
    for path in sorted(path for path in run.rglob("*") if path.is_file()):
        name = str(path.relative_to(run))
        if name in ("metrics.jsonl", "validation.jsonl"):
            found[name] = [without_times(json.loads(line)) for line in path.read_text().splitlines()]
        elif name == "eval/summary.json":
            found[name] = without_times(json.loads(path.read_text()))
        elif path.name == "state.json":
            found[name] = json.loads(path.read_text())["progress"]
        elif path.suffix == ".bpk" or name in ("config.toml", "lock", "eval/report.html", "eval/views.csv"):
            found[name] = "there"  # random ids of parameters, the run's own path, times
        else:
            found[name] = path.read_bytes()
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clift", type=Path, default=ROOT / "target/release/clift", help="the binary")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = random.Random(args.seed)
    place = Path(tempfile.mkdtemp(prefix="clift-crash-"))
    started = time.monotonic()
    subprocess.run(command(args.clift, place / "whole"), check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    whole_s = time.monotonic() - started
    expected = result(place / "whole")
    print(f"undisturbed: {whole_s:.1f} s, {len(expected)} files")

    kills, finished, by_stage, num_in_save = 0, 0, dict[str, int](), 0
    while kills < args.kills:
        run = place / f"run{finished}"
        kills_before, started_run = kills, time.monotonic()
        while True:
            child = subprocess.Popen(command(args.clift, run), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            if kills < args.kills:
                wait(child, run, rng.random() * whole_s, kills % 2 == 0, rng)
                child.send_signal(signal.SIGKILL)
            errors = child.communicate()[1].decode()
            if child.returncode == -signal.SIGKILL:
                kills += 1
                stage, left = stage_of(run), saves(run)
                by_stage[stage] = by_stage.get(stage, 0) + 1
                num_in_save += bool(left)
                print(f"kill {kills}: {stage}{', in a save: ' + ', '.join(left) if left else ''}")
                continue
            if child.returncode != 0:
                print(f"{run} does not go on:\n{errors}")
                return 1
            break
        found = result(run)
        wrong = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
        if wrong:
            print(f"{run} ended differently from {place / 'whole'}: {', '.join(wrong)}")
            return 1
        if kills == kills_before:
            # On a busy machine runs differ in length: moments after the end would kill nothing.
            whole_s = min(whole_s, time.monotonic() - started_run)
        print(f"run {finished} ended as the undisturbed one", flush=True)
        finished += 1
        shutil.rmtree(run)
    counts = ", ".join(f"{count} in {stage}" for stage, count in sorted(by_stage.items()))
    took = time.monotonic() - started
    print(f"{kills} kills ({counts}), {num_in_save} of them in a save; {finished} runs, all equal to the undisturbed one; {took:.0f} s")
    shutil.rmtree(place)
    return 0


if __name__ == "__main__":
    sys.exit(main())
