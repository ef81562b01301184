"""Compares how fast clift and pixelSplat's way read the same clips of the same files, alternately.

    python scripts/bench/bench_data.py DIR --clift target/release/clift [--rounds 3] [--json F]
    python scripts/bench/bench_data.py DIR --make PATH [--mb 100 --chunks 3]     # chunks made of DIR's frames, 640 x 360
    python scripts/bench/bench_data.py DIR --clift EXE --big 2000                # also the memory on one chunk of 2 GB

Needs torch, Pillow and numpy. pixelSplat's way: `torch.load` of a whole chunk, Pillow for decoding and LANCZOS, floats
in between as its code has them, and a DataLoader with two workers that share the chunks. For a single clip it has to
load the chunk that the clip is in. clift reads the same frames: `clift bench data --json` names them.

In order: clips per second, all of them, two workers on either side. At random: seconds from asking for a clip to having
it. Memory: the kernel's peak; of pixelSplat's way that of its largest process alone.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Iterator

import numpy as np
import torch
from PIL import Image
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

NUM_WORKERS = 2


# ------------------------------------------------------------ pixelSplat's way


def decoded(image: torch.Tensor) -> torch.Tensor:
    """A file to floats in [0, 1], as torchvision's ToTensor has it."""
    picture = np.array(Image.open(io.BytesIO(image.numpy().tobytes())).convert("RGB"))
    return torch.from_numpy(picture).permute(2, 0, 1).float() / 255


def rescaled(image: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """Back to 8 bits, Pillow's LANCZOS, and to floats again; then the crop."""
    _, rows, columns = image.shape
    scale = max(height / rows, width / columns)
    scaled = (round(columns * scale), round(rows * scale))
    pixels = (image * 255).clip(min=0, max=255).type(torch.uint8).permute(1, 2, 0).numpy()
    resized = np.array(Image.fromarray(pixels).resize(scaled, Image.LANCZOS)) / 255
    tensor = torch.tensor(resized, dtype=torch.float32).permute(2, 0, 1)
    row, column = (scaled[1] - height) // 2, (scaled[0] - width) // 2
    return tensor[:, row : row + height, column : column + width]


def clip(scene: dict[str, Any], frames: list[list[int]], size: list[int]) -> dict[str, Any]:
    """Contexts and targets of a scene, with their cameras."""
    cameras = scene["cameras"]
    intrinsics = torch.eye(3).repeat(len(cameras), 1, 1)
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = cameras[:, 0], cameras[:, 1]
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = cameras[:, 2], cameras[:, 3]
    w2c = torch.eye(4).repeat(len(cameras), 1, 1)
    w2c[:, :3] = cameras[:, 6:].reshape(-1, 3, 4)
    c2w = w2c.inverse()
    views = []
    for indices in frames:
        images = torch.stack([decoded(scene["images"][index]) for index in indices])
        images = torch.stack([rescaled(image, *size) for image in images])
        views.append({"image": images, "extrinsics": c2w[indices], "intrinsics": intrinsics[indices]})
    return {"context": views[0], "target": views[1], "scene": scene["key"]}


class Chunks(IterableDataset):
    """Chunk after chunk, each worker its share, the wanted clips of each scene."""

    def __init__(self, folder: Path, clips: list[dict[str, Any]], size: list[int]) -> None:
        self.folder, self.size = folder, size
        self.index = json.loads((folder / "index.json").read_text())
        self.wanted: dict[str, list[list[list[int]]]] = {}
        for item in clips:
            self.wanted.setdefault(item["key"], []).append([item["context"], item["target"]])

    def __iter__(self) -> Iterator[dict[str, Any]]:
        worker = get_worker_info()
        chunks = sorted({self.index[key] for key in self.wanted})
        for name in chunks[worker.id :: worker.num_workers] if worker else chunks:
            for scene in torch.load(self.folder / name, weights_only=True):
                for frames in self.wanted.get(scene["key"], []):
                    yield clip(scene, frames, self.size)


def pixelsplat_in_order(folder: Path, clips: list[dict[str, Any]], size: list[int]) -> float:
    """Clips per second."""
    loader = DataLoader(Chunks(folder, clips, size), batch_size=None, num_workers=NUM_WORKERS)
    start = time.perf_counter()
    count = sum(1 for _ in loader)
    assert count == len(clips), (count, len(clips))
    return count / (time.perf_counter() - start)


def pixelsplat_at_random(folder: Path, clips: list[dict[str, Any]], size: list[int]) -> float:
    """Median seconds of a clip."""
    index = json.loads((folder / "index.json").read_text())
    seconds = []
    for item in clips:
        start = time.perf_counter()
        scenes = torch.load(folder / index[item["key"]], weights_only=True)
        scene = next(scene for scene in scenes if scene["key"] == item["key"])
        clip(scene, [item["context"], item["target"]], size)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def worker(arguments: str) -> None:
    """One measurement in a process of its own; prints the figure and the peak memory."""
    task = json.loads(arguments)
    torch.set_num_threads(1)
    run = {"in_order": pixelsplat_in_order, "at_random": pixelsplat_at_random}[task["what"]]
    figure = run(Path(task["folder"]), json.loads(Path(task["clips"]).read_text())[task["list"]], task["size"])
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(json.dumps({"figure": figure, "peak_bytes": peak * 1024}))


# ------------------------------------------------------------ the comparison


def ours(clift: Path, folder: Path, args: argparse.Namespace, out: Path) -> dict[str, Any]:
    command = [str(clift), "bench", "data", str(folder), "--json", str(out), "--force", "--clips", str(args.clips)]
    command += ["--size", args.size, "--threads", str(NUM_WORKERS)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return json.loads(out.read_text())


def theirs(
    what: str, folder: Path, clips: Path, which: str, size: list[int], limit: int | None = None
) -> dict[str, Any]:
    if limit is not None:
        lists = json.loads(clips.read_text())
        clips = clips.with_name("few.json")
        clips.write_text(json.dumps({**lists, which: lists[which][:limit]}))
    task = {"what": what, "folder": str(folder), "clips": str(clips), "list": which, "size": size}
    command = [sys.executable, __file__, "--worker", json.dumps(task)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def compare(clift: Path, root: Path, args: argparse.Namespace) -> dict[str, Any]:
    size = [int(side) for side in args.size.split("x")]
    folder = root / "train"
    names = ("ours_in_order", "theirs_in_order", "ours_random_s", "theirs_random_s")
    rows: dict[str, list[float]] = {name: [] for name in names}
    peaks: dict[str, int] = {"ours": 0, "theirs": 0}
    with tempfile.TemporaryDirectory() as scratch:
        clips = Path(scratch) / "clips.json"
        for number in range(args.rounds):

            def run_ours() -> None:
                result = ours(clift, root, args, clips)
                rows["ours_in_order"].append(result["sequential_clips_per_s"])
                rows["ours_random_s"].append(result["random_median_s"])
                peaks["ours"] = max(peaks["ours"], result["peak_bytes"] or 0)

            def run_theirs() -> None:
                result = theirs("in_order", folder, clips, "sequential", size)
                rows["theirs_in_order"].append(result["figure"])
                peaks["theirs"] = max(peaks["theirs"], result["peak_bytes"])
                result = theirs("at_random", folder, clips, "random", size, limit=args.random)
                rows["theirs_random_s"].append(result["figure"])

            # The first round needs clift's list of clips; after it the order alternates.
            for side in (run_ours, run_theirs) if number % 2 == 0 else (run_theirs, run_ours):
                side()
    figures = {name: statistics.median(values) for name, values in rows.items()}
    figures["in_order_ratio"] = figures["ours_in_order"] / figures["theirs_in_order"]
    figures["random_ratio"] = figures["theirs_random_s"] / figures["ours_random_s"]
    return {"rounds": rows, **figures, "peak_bytes": peaks, "load_average": os.getloadavg()[0]}


def make(source: Path, out: Path, megabytes: int, num_chunks: int) -> None:
    """Chunks of `source`'s frames at 640 x 360, in scenes of 100 frames, each file by itself."""
    frames: list[bytes] = []
    cameras: list[torch.Tensor] = []
    for chunk in sorted(source.rglob("*.torch")):
        for scene in torch.load(chunk, weights_only=True):
            for image, camera in zip(scene["images"], scene["cameras"]):
                picture = Image.open(io.BytesIO(image.numpy().tobytes())).convert("RGB").resize((640, 360), Image.LANCZOS)
                file = io.BytesIO()
                picture.save(file, "JPEG", quality=92)
                frames.append(file.getvalue())
                cameras.append(camera)
    folder = out / "train"
    folder.mkdir(parents=True)
    index, place = {}, 0
    for number in range(num_chunks):
        scenes: list[dict[str, Any]] = []
        written = 0
        while written < megabytes * 1_000_000:
            which = [(place + frame) % len(frames) for frame in range(100)]
            images = [torch.frombuffer(bytearray(frames[i]), dtype=torch.uint8) for i in which]
            written += sum(len(image) for image in images)
            key = f"{place:016x}"
            place += 100
            stack = torch.stack([cameras[i] for i in which])
            # Clips of different tracks follow each other: any baseline will do.
            stack[:, 9] += 0.01 * torch.arange(100)
            scenes.append({"url": "", "timestamps": torch.arange(100), "cameras": stack, "images": images, "key": key})
            index[key] = f"{number:06}.torch"
        torch.save(scenes, folder / f"{number:06}.torch")
    (folder / "index.json").write_text(json.dumps(index))


def main() -> None:
    if sys.argv[1:2] == ["--worker"]:
        return worker(sys.argv[2])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="a folder of chunks")
    parser.add_argument("--clift", type=Path)
    parser.add_argument("--make", type=Path, metavar="PATH", help="write chunks there and stop")
    parser.add_argument("--mb", type=int, default=100, help="megabytes of a chunk")
    parser.add_argument("--chunks", type=int, default=3)
    parser.add_argument("--big", type=int, metavar="MB", help="also measure on one chunk of so many megabytes")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--clips", type=int, default=120)
    parser.add_argument("--random", type=int, default=12, help="random clips of pixelSplat's way per round")
    parser.add_argument("--size", default="256x256")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.make:
        return make(args.source, args.make, args.mb, args.chunks)
    if not args.clift:
        parser.error("write --clift, the program that cargo built")
    report: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        usual = Path(scratch) / "usual"
        make(args.source, usual, args.mb, args.chunks)
        report["usual"] = compare(args.clift, usual, args)
        if args.big:
            big = Path(scratch) / "big"
            make(args.source, big, args.big, 1)
            few = argparse.Namespace(**{**vars(args), "rounds": 1, "random": 2})
            report["big"] = compare(args.clift, big, few)
    for name, row in report.items():
        print(
            f"{name}: in order {row['ours_in_order']:.1f} against {row['theirs_in_order']:.1f} clips/s "
            f"({row['in_order_ratio']:.2f}x), a random clip {row['ours_random_s'] * 1e3:.0f} against "
            f"{row['theirs_random_s'] * 1e3:.0f} ms ({row['random_ratio']:.1f}x), peak memory "
            f"{row['peak_bytes']['ours'] / 1e6:.0f} against {row['peak_bytes']['theirs'] / 1e6:.0f} MB, "
            f"load average {row['load_average']:.1f}"
        )
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
