"""Puts the usual mistakes into the cameras of good scenes and counts what `clift data check` finds.

    python3 scripts/check/check_mistakes.py DIR.. [--clift target/release/clift] [--repeats 3] [--json FILE]

Writes every scene of the chunks in the folders to a file of its own in a temporary folder, changes the cameras there, and
calls `clift data check`. Scenes that are not ok unchanged are listed and left out. Prints a table of every mistake: scenes
flagged, scenes whose reason names the mistake (of a single camera: its frame), and the scenes missed. Needs PyTorch.
"""

import argparse
import io
import json
import math
import pickle
import random
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import torch

OPPOSITE_AXES = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]


def product(a, b):
    return [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]


def transposed(a):
    return [list(row) for row in zip(*a)]


def applied(a, v):
    return [sum(a[i][k] * v[k] for k in range(3)) for i in range(3)]


def turn(rng, angle_deg):
    """A rotation by the angle about a random axis (Rodrigues' formula)."""
    axis = [rng.gauss(0, 1) for _ in range(3)]
    length = math.hypot(*axis)
    x, y, z = (value / length for value in axis)
    cross = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    square = product(cross, cross)
    sine, cosine = math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))
    return [[(i == j) + sine * cross[i][j] + (1 - cosine) * square[i][j] for j in range(3)] for i in range(3)]


def inverse(rotation, translation):
    rotation = transposed(rotation)
    return rotation, [-value for value in applied(rotation, translation)]


class Camera:
    """Intrinsics, and camera-to-world rotation and translation, of the 18 numbers of a chunk."""

    def __init__(self, row):
        self.intrinsics = list(row[:6])
        w2c = [row[6 + 4 * i : 10 + 4 * i] for i in range(3)]
        self.rotation, self.translation = inverse([row[:3] for row in w2c], [row[3] for row in w2c])

    def row(self):
        rotation, translation = inverse(self.rotation, self.translation)
        return [*self.intrinsics, *(value for i in range(3) for value in (*rotation[i], translation[i]))]

    def turned(self, rotation):
        self.rotation = product(self.rotation, rotation)

    def scaled(self, factor):
        self.intrinsics[:2] = [value * factor for value in self.intrinsics[:2]]

    def exchanged(self, other):
        for name in ("intrinsics", "rotation", "translation"):
            mine, theirs = getattr(self, name), getattr(other, name)
            setattr(self, name, theirs)
            setattr(other, name, mine)


def axes(cameras, _):
    for camera in cameras:
        camera.turned(OPPOSITE_AXES)
    return "axes of every camera reversed (OpenGL"


def inverted(cameras, _):
    for camera in cameras:
        camera.rotation, camera.translation = inverse(camera.rotation, camera.translation)
    return "every pose inverted ("


def focal(factor, named):
    def change(cameras, _):
        for camera in cameras:
            camera.scaled(factor)
        return f"focal lengths times {named}"

    return change


def neighbours(cameras, rng):
    first = rng.randrange(len(cameras) - 1)
    cameras[first].exchanged(cameras[first + 1])
    return f"frames {first} and {first + 1} are exchanged"


def one_turned(angle_deg):
    def change(cameras, rng):
        frame = rng.randrange(len(cameras))
        cameras[frame].turned(turn(rng, angle_deg))
        return f"of 1 frame ({frame}) do not fit"

    return change


def all_turned(angle_deg):
    def change(cameras, rng):
        rotation = turn(rng, angle_deg)
        for camera in cameras:
            camera.turned(rotation)
        return "every camera turned by"

    return change


def world_turned(cameras, rng):
    """No mistake: another world frame."""
    rotation = turn(rng, 40)
    for camera in cameras:
        camera.rotation = product(rotation, camera.rotation)
        camera.translation = applied(rotation, camera.translation)
    return None


# Name, change, whether it is repeated, whether the goal counts it.
MISTAKES = [
    ("OpenGL axes for OpenCV axes", axes, False, True),
    ("w2c for c2w", inverted, False, True),
    ("focal lengths + 10 %", focal(1.1, 0.9), False, True),
    ("focal lengths - 10 %", focal(0.9, 1.1), False, True),
    ("two neighbours exchanged", neighbours, True, True),
    ("one camera turned by 2 degrees", one_turned(2), True, True),
    ("one camera turned by 1 degree", one_turned(1), False, False),
    ("one camera turned by 0.5 degrees", one_turned(0.5), False, False),
    ("every camera turned by 5 degrees", all_turned(5), True, True),
    ("every camera turned by 2 degrees", all_turned(2), False, False),
    ("every camera turned by 1 degree", all_turned(1), False, False),
    ("focal lengths + 5 %", focal(1.05, 0.9), False, False),
    ("another world frame (no mistake)", world_turned, False, False),
]


class TensorReader(pickle.Unpickler):
    """Reads the pickle of a scene file; a tensor becomes the name of its storage and the number of its first element."""

    def find_class(self, module, name):
        return (lambda storage, offset, *_: (storage, offset)) if name == "_rebuild_tensor_v2" else (lambda *_: None)

    def persistent_load(self, pid):
        return pid[2]


def changed_scene(source, target, change):
    """Copies a scene file with changed cameras."""
    with zipfile.ZipFile(source) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    pickled = next((name, data) for name, data in members if name.endswith("data.pkl"))
    scene = TensorReader(io.BytesIO(pickled[1])).load()
    storage, offset = scene["cameras"]
    name = pickled[0].replace("data.pkl", f"data/{storage}")
    count = len(scene["images"])
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:
        for member, data in members:
            if member == name:
                rows = struct.unpack_from(f"<{18 * count}f", data, 4 * offset)
                cameras = [Camera(rows[18 * i : 18 * i + 18]) for i in range(count)]
                expected = change(cameras)
                values = [value for camera in cameras for value in camera.row()]
                data = bytearray(data)
                struct.pack_into(f"<{18 * count}f", data, 4 * offset, *values)
            archive.writestr(member, bytes(data))
    return expected


def run(*command):
    return subprocess.run([str(word) for word in command], capture_output=True, text=True)


def checked(clift, folder):
    """The findings of `clift data check` by file, for scenes in numbered folders."""
    found = {}
    report = folder.parent / "check.json"
    for data in sorted(folder.iterdir()):
        report.unlink(missing_ok=True)
        done = run(clift, "data", "check", data, "--json", report)
        if not report.exists():
            sys.exit(f"clift data check failed: {done.stderr}")
        for row in json.loads(report.read_text())["scenes"]:
            found[f"{data.name}/{row['key']}.torch"] = row
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--clift", type=Path, default=Path("target/release/clift"))
    parser.add_argument("--repeats", type=int, default=3, help="repeats of exchanged and turned cameras, at random frames")
    parser.add_argument("--json", type=Path, help="write the findings of every scene")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        for number, folder in enumerate(args.folders):
            (root / f"good/{number}").mkdir(parents=True)
            for path in folder.glob("**/*.torch"):
                loaded = torch.load(path, weights_only=True)
                for scene in [loaded] if isinstance(loaded, dict) else loaded:
                    torch.save(scene, root / f"good/{number}" / f"{scene['key']}.torch")
        good = checked(args.clift, root / "good")
        for row in good.values():
            px = row["epipolar_px"]
            print(f"{row['key']}: {row['verdict']}, {row['num_frames']} frames, {'-' if px is None else f'{px:.2f} px'}")
        print(f"unchanged: {sum(row['verdict'] == 'ok' for row in good.values())} of {len(good)} ok\n")
        files = [file for file, row in good.items() if row["verdict"] == "ok"]
        findings = {"unchanged": list(good.values())}
        print("| mistake | found | named | missed |\n|---|---|---|---|", flush=True)
        total = [0, 0]
        for name, change, is_repeated, counts in MISTAKES:
            found, named, missed, tried = 0, 0, [], 0
            findings[name] = []
            for repeat in range(args.repeats if is_repeated else 1):
                folder = root / "changed"
                expected = {}
                for file in files:
                    (folder / file).parent.mkdir(parents=True, exist_ok=True)
                    rng = random.Random(f"{name} {file} {repeat}")
                    expected[file] = changed_scene(
                        root / "good" / file, folder / file, lambda cameras: change(cameras, rng)
                    )
                for file, row in checked(args.clift, folder).items():
                    tried += 1
                    is_found = row["verdict"] == "flagged"
                    found += is_found
                    named += any((expected[file] or "-") in reason for reason in row["reasons"])
                    missed += [] if is_found else [row["key"][:12]]
                    findings[name].append({"expected": expected[file], **row})
                shutil.rmtree(folder)
            total = [total[0] + counts * found, total[1] + counts * tried]
            names = "-" if found == 0 else ", ".join(missed) or "-"
            print(f"| {name}{' (*)' if counts else ''} | {found} of {tried} | {named} | {names} |", flush=True)
        print(f"\n(*) together: {total[0]} of {total[1]} found, {100 * total[0] / max(total[1], 1):.1f} %")
    if args.json:
        args.json.write_text(json.dumps(findings, indent=1))


if __name__ == "__main__":
    main()
