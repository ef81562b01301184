"""Runs commands one at a time on a quiet Linux machine, and knows when it is not quiet.

Standard library only. The caller should stay small as well: Linux counts what a process held before `exec` to the
peak memory of the command it starts.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

JIFFY = os.sysconf("SC_CLK_TCK")
SAMPLE_SECONDS = 1.5
# Of foreign processor time per command: the clock ticks in hundredths, and the kernel has its own chores.
GRACE_SECONDS = 0.05


class Loaded(Exception):
    """Somebody else uses the processor."""


class CommandFailed(Exception):
    """A command did not exit with 0."""


@dataclass
class Finished:
    """What a command said and used."""

    stdout: str
    peak_bytes: int
    wall_s: float
    # Cores that others kept busy meanwhile, on average.
    foreign_cores: float


def cpu_model() -> str:
    """The processor's name, family and model: the name alone is often that of a whole series."""
    fields = dict(line.split(":", 1) for line in Path("/proc/cpuinfo").read_text().splitlines() if ":" in line)
    found = {name.strip(): value.strip() for name, value in fields.items()}
    numbers = [f"{name} {found[key]}" for name, key in (("family", "cpu family"), ("model", "model")) if key in found]
    return ", ".join([found.get("model name", "unknown"), *numbers])


def physical_cores() -> int:
    """Cores of the machine without their second threads, as far as this process may use them."""
    found = set()
    for cpu in os.sched_getaffinity(0):
        topology = Path(f"/sys/devices/system/cpu/cpu{cpu}/topology")
        try:
            found.add(tuple((topology / name).read_text().strip() for name in ("physical_package_id", "core_id")))
        except OSError:
            found.add((str(cpu),))
    return len(found)


def busy_seconds() -> float:
    """Processor time that all cores together have spent on anything since the start, theft by a host included."""
    user, nice, system, _idle, _iowait, irq, softirq, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + irq + softirq + steal) / JIFFY


def process_seconds() -> dict[str, float]:
    """Processor time of every process, by `name (pid)`."""
    found = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            head, _, tail = stat.read_text().rpartition(")")
        except OSError:
            continue  # ended meanwhile
        pid, _, name = head.partition(" (")
        fields = tail.split()
        found[f"{name} ({pid})"] = (int(fields[11]) + int(fields[12])) / JIFFY
    return found


def load() -> tuple[float, str]:
    """Cores that are busy right now, and a sentence that names who uses them."""
    before, processes, start = busy_seconds(), process_seconds(), time.monotonic()
    time.sleep(SAMPLE_SECONDS)
    seconds = time.monotonic() - start
    busy = (busy_seconds() - before) / seconds
    used = {name: (after - processes.get(name, 0.0)) / seconds for name, after in process_seconds().items()}
    most = sorted(used.items(), key=lambda item: -item[1])[:3]
    names = ", ".join(f"{name} {cores:.2f}" for name, cores in most if cores >= 0.02)
    return busy, f"{busy:.2f} of {os.cpu_count()} cores are busy" + (f": {names}" if names else "")


def wait_until_quiet(max_busy: float, max_wait: float) -> None:
    """Returns once at most `max_busy` cores are busy; raises `Loaded` after `max_wait` seconds."""
    deadline = time.monotonic() + max_wait
    warned = False
    while True:
        busy, sentence = load()
        if busy <= max_busy:
            return
        if time.monotonic() >= deadline:
            raise Loaded(f"{sentence}; waited {max_wait:.0f} s for at most {max_busy}")
        if not warned:
            print(f"  waiting: {sentence}", flush=True)
            warned = True


def run(command: list[str], extra_env: dict[str, str]) -> Finished:
    """Runs a command to its end, with its own peak memory (`ru_maxrss`)."""
    with tempfile.TemporaryFile("w+") as stdout, tempfile.TemporaryFile("w+") as stderr:
        before, start = busy_seconds(), time.monotonic()
        try:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr, env={**os.environ, **extra_env}
            )
        except OSError as error:
            raise CommandFailed(f"{command[0]} does not start: {error.strerror}") from None
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.kill()
            process.wait()
            raise
        process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.monotonic() - start
        foreign = (busy_seconds() - before - usage.ru_utime - usage.ru_stime - GRACE_SECONDS) / wall
        texts = []
        for stream in (stdout, stderr):
            stream.seek(0)
            texts.append(stream.read())
    if process.returncode != 0:
        tail = "\n".join(f"    {line}" for line in texts[1].strip().splitlines()[-15:])
        raise CommandFailed(f"exit code {process.returncode} of `{' '.join(command)}`\n{tail or '    (no message)'}")
    return Finished(texts[0], usage.ru_maxrss * 1024, wall, max(foreign, 0.0))
