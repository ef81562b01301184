"""Makes `data-fixtures/layouts`, one scene in every layout that is read, and the references for lens distortion.

    python scripts/make_layout_fixtures.py [OUTPUT_DIR]

Needs torch, Pillow, numpy, scipy, safetensors, opencv-python-headless and pycolmap. Every picture and pose is computed
from a formula. The files are checked in; running this again is needed only when a fixture changes.

Poses are turned into each layout's convention here, by matrices and by COLMAP's own code, and not by clift.
"""

import hashlib
import io
import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch
from PIL import Image
from safetensors.numpy import save_file
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, NUM_FRAMES = 32, 18, 6
KEY = hashlib.sha256(b"a scene").hexdigest()
# Over width and height, the principal point off the centre.
FX, FY, CX, CY = 0.875, 1.5625, 0.515625, 0.46875
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# Lenses of COLMAP's models, in pixels of a 96x72 picture.
LENSES = {
    "SIMPLE_RADIAL": [80.0, 49.0, 35.0, 0.09],
    "RADIAL": [80.0, 49.0, 35.0, -0.21, 0.06],
    "OPENCV": [80.0, 82.0, 49.0, 35.0, 0.058, -0.081, -0.0021, 0.0016],
}


def picture(height, width, phase):
    """Bands that move with the frame, over a coarse checkerboard: small as PNG, and no two frames alike."""
    y, x = np.mgrid[0:height, 0:width]
    checker = (x // 4 + y // 3) % 2 * 40
    channels = [(x * (3 + c) + y * (5 - c) + phase * (11 + 7 * c)) % 200 + checker for c in range(3)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def pose(frame):
    """Camera to world in OpenCV's axes: a turning, climbing path away from the origin."""
    c2w = np.eye(4)
    c2w[:3, :3] = Rotation.from_euler("yxz", [0.3 + 0.05 * frame, -0.2 + 0.02 * frame, 0.1]).as_matrix()
    c2w[:3, 3] = [1.0 + 0.2 * frame, -0.5 + 0.03 * frame**2, 2.0 - 0.1 * frame]
    return c2w


def png(frame):
    """The file of one frame, the same bytes in every layout."""
    file = io.BytesIO()
    Image.fromarray(picture(HEIGHT, WIDTH, frame)).save(file, "PNG", optimize=True)
    return file.getvalue()


def write_pictures(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for frame, name in enumerate(names):
        (folder / name).write_bytes(png(frame))


def torch_scene(key):
    """The scene as pixelSplat's and CLiFT's files have it."""
    rows = [[FX, FY, CX, CY, 0.0, 0.0, *np.linalg.inv(pose(frame))[:3].flatten()] for frame in range(NUM_FRAMES)]
    return {
        "url": "",
        "timestamps": torch.arange(NUM_FRAMES, dtype=torch.int64),
        "cameras": torch.tensor(rows, dtype=torch.float32),
        "images": [torch.from_numpy(np.frombuffer(png(frame), np.uint8).copy()) for frame in range(NUM_FRAMES)],
        "key": key,
    }


def write_torch(root):
    """Chunks as pixelSplat and DepthSplat have them, and a file per scene as CLiFT does."""
    for layout, split, key in [("chunks", "test", KEY), ("depthsplat", "train", f"dl3dv_{KEY}")]:
        folder = root / layout / split
        folder.mkdir(parents=True)
        torch.save([torch_scene(key)], folder / "000000.torch")
        (folder / "index.json").write_text(json.dumps({key: "000000.torch"}) + "\n")
    folder = root / "scenes" / "test"
    folder.mkdir(parents=True)
    torch.save(torch_scene(KEY), folder / f"{KEY}.torch")
    (folder / "invalid_keys.txt").write_text("0000000000000000\n")


def write_re10k_text(root):
    """RealEstate10K as published, with frames in folders of their own, and the same with both in one folder."""
    times = [1_000_000 + 33_367 * frame for frame in range(NUM_FRAMES)]
    lines = ["https://example.org/watch"]
    for frame, time in enumerate(times):
        numbers = [FX, FY, CX, CY, 0.0, 0.0, *np.linalg.inv(pose(frame))[:3].flatten()]
        lines.append(" ".join([str(time), *(f"{number:.9f}" for number in numbers)]))
    text = "\n".join(lines) + "\n"
    folder = root / "re10k_txt" / "test"
    folder.mkdir(parents=True)
    (folder / f"{KEY}.txt").write_text(text)
    write_pictures(root / "re10k_txt" / "frames" / KEY, [f"{time:010d}.png" for time in times])
    folder = root / "re10k_folders" / KEY
    write_pictures(folder / "frames", [f"{time}.png" for time in times])
    (folder / "cameras.txt").write_text(text)


def transforms(names, scale):
    """A `transforms.json` with cameras at the top, for pictures `scale` times as large as those on disk."""
    width, height = WIDTH * scale, HEIGHT * scale
    frames = [
        {"file_path": name, "transform_matrix": (pose(frame) @ OPENGL).tolist()} for frame, name in enumerate(names)
    ]
    top = {"w": width, "h": height, "fl_x": FX * width, "fl_y": FY * height, "cx": CX * width, "cy": CY * height}
    return {"camera_model": "OPENCV", **top, "frames": frames}


def write_dl3dv(root):
    """DL3DV flat, below 1K and as in its benchmark. Lens terms are there and are to be ignored."""
    names = [f"frame_{frame + 1:05d}.png" for frame in range(NUM_FRAMES)]
    document = {**transforms([f"images/{name}" for name in names], 8), "k1": 0.02, "k2": -0.01, "p1": 1e-4, "p2": 0.0}
    for place in ["dl3dv_flat", "dl3dv/1K", "dl3dv_benchmark"]:
        scene = root / place / KEY
        if place == "dl3dv_benchmark":
            scene = scene / "nerfstudio"
        write_pictures(scene / ("images_4" if place == "dl3dv_flat" else "images_8"), names)
        (scene / "transforms.json").write_text(json.dumps(document) + "\n")


def write_capture(root):
    """An own capture: frames in no order, intrinsics per frame, no file endings, and one frame without a picture."""
    names = [f"{frame + 8}.png" for frame in range(NUM_FRAMES)]  # 8, 9, 10: not in the order of letters
    write_pictures(root / "capture" / "attic" / "images", names)
    document = transforms([f"./images/{Path(name).stem}" for name in names], 1)
    optics = {key: document.pop(key) for key in ["w", "h", "fl_x", "fl_y", "cx", "cy"]}
    frames = [{**optics, **frame} for frame in document["frames"]]
    # A frame of another camera, without a picture.
    missing = {**frames[0], "file_path": "./images/99", "fl_x": 1.0}
    document["frames"] = [frames[place] for place in [4, 0, 5, 2]] + [missing] + [frames[place] for place in [1, 3]]
    (root / "capture" / "attic" / "transforms.json").write_text(json.dumps(document) + "\n")


def colmap_model(model, params, width, height, images):
    """A COLMAP model with one camera and `images`, pairs of a name and a pose. Each has a few points."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=width, height=height, params=params, camera_id=7)
    reconstruction.add_camera_with_trivial_rig(camera)
    for number, (name, c2w) in enumerate(images):
        w2c = np.linalg.inv(c2w)
        points = pycolmap.Point2DList([pycolmap.Point2D(np.array([3.5 + i, 2.25 * i])) for i in range(number % 3)])
        image = pycolmap.Image(name=name, points2D=points, camera_id=7, image_id=40 - number)
        motion = pycolmap.Rigid3d(pycolmap.Rotation3d(w2c[:3, :3]), w2c[:3, 3])
        reconstruction.add_image_with_trivial_frame(image, motion)
    return reconstruction


def write_colmap(root):
    """COLMAP models, binary and text, as COLMAP itself writes them."""
    names = [f"left/frame {frame + 8}.png" for frame in range(NUM_FRAMES)]
    params = [FX * WIDTH, FY * HEIGHT, CX * WIDTH, CY * HEIGHT]
    for form in ["bin", "txt"]:
        scene = root / f"colmap_{form}" / "attic"
        model = scene / "sparse" / "0"
        model.mkdir(parents=True)
        write_pictures(scene / "images" / "left", [Path(name).name for name in names])
        images = [(name, pose(frame)) for frame, name in enumerate(names)]
        reconstruction = colmap_model("PINHOLE", params, WIDTH, HEIGHT, images)
        (reconstruction.write_binary if form == "bin" else reconstruction.write_text)(str(model))
        for file in model.iterdir():
            if file.stem not in ["cameras", "images"]:
                file.unlink()


def edge_rays(camera_matrix, distortion, width, height):
    """Undistorted rays of points along the four edges of a picture, as OpenCV finds them."""
    share = np.linspace(0.0, 1.0, 2001)
    edges = {
        "left": np.stack([0 * share, share * height], axis=1),
        "right": np.stack([0 * share + width, share * height], axis=1),
        "top": np.stack([share * width, 0 * share], axis=1),
        "bottom": np.stack([share * width, 0 * share + height], axis=1),
    }
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
    undistort = lambda points: cv2.undistortPoints(points[:, None], camera_matrix, distortion, None, None, None, criteria)
    return {name: undistort(points)[:, 0] for name, points in edges.items()}


def write_lenses(folder):
    """`MODEL.params` (COLMAP's), `.rays` and the pixels that COLMAP projects them to; the picture that OpenCV makes of
    `picture` with the focal factor `zoom`, u8 [72, 96, 3]. OpenCV's pixel centres are whole numbers, COLMAP's halves."""
    width, height = 96, 72
    source = cv2.GaussianBlur(picture(height, width, 3), (5, 5), 1.0)
    tensors = {"picture": source}
    rays = np.random.default_rng(5).uniform(-0.55, 0.55, (40, 2)) * [1.0, 0.75]
    for model, params in LENSES.items():
        camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
        tensors[f"{model}.params"] = np.array(params)
        tensors[f"{model}.rays"] = rays
        tensors[f"{model}.pixels"] = camera.img_from_cam(np.concatenate([rays, np.ones((40, 1))], axis=1))
        fx, fy, cx, cy = params[:4] if model == "OPENCV" else (params[0], *params[:3])
        lens = np.array({"SIMPLE_RADIAL": [*params[3:], 0, 0, 0], "RADIAL": [*params[3:], 0, 0]}.get(model, params[4:]))
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        edges = edge_rays(matrix, lens, width, height)
        # The rectangle of rays that lies within all four edges, and the least focal length that fills it.
        zoom = max(
            cx / -edges["left"][:, 0].max() / fx,
            (width - cx) / edges["right"][:, 0].min() / fx,
            cy / -edges["top"][:, 1].max() / fy,
            (height - cy) / edges["bottom"][:, 1].min() / fy,
        )
        half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        to = matrix * [[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]]
        maps = cv2.initUndistortRectifyMap(matrix - half, lens, None, to - half, (width, height), cv2.CV_32FC1)
        tensors[f"{model}.zoom"] = np.array([zoom])
        tensors[f"{model}.undistorted"] = cv2.remap(source, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    save_file({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}, folder / "lenses.safetensors")


def main():
    default = Path(__file__).resolve().parent.parent / "data-fixtures"
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    layouts = root / "layouts"
    shutil.rmtree(layouts, ignore_errors=True)
    (root / "reference").mkdir(parents=True, exist_ok=True)
    for write in [write_torch, write_re10k_text, write_dl3dv, write_capture, write_colmap]:
        write(layouts)
    write_lenses(root / "reference")


if __name__ == "__main__":
    main()
