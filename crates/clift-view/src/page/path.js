// Keyframes, the smooth path through them, and its file.

import { pathAt, toWorldRows } from "./camera.js";

/** Frames per second of the exported path, the default of `clift render`. */
export const PATH_FPS = 20;

export class CameraPath {
  constructor() {
    this.keyframes = [];
    this.seconds = 4;
  }

  get isMoving() {
    return this.keyframes.length > 1;
  }

  /** The camera at a share of the path in [0, 1]. */
  at(share) {
    return pathAt(this.keyframes, share * (this.keyframes.length - 1));
  }

  /** The cameras of the exported frames; the first and the last are keyframes. */
  frames() {
    if (!this.isMoving) return [...this.keyframes];
    const count = Math.max(2, Math.round(this.seconds * PATH_FPS));
    return Array.from({ length: count }, (_, i) => this.at(i / (count - 1)));
  }
}

/** The text of a pose file of `clift render --path`: cameras in the world of the capture. */
export function poseFile(cameras, scene) {
  const poses = cameras.map((camera) => ({
    c2w: toWorldRows(camera, scene.meanC2w, scene.scale),
    intrinsics_norm: camera.intrinsics,
  }));
  return `{"poses": [\n${poses.map((pose) => JSON.stringify(pose)).join(",\n")}\n]}\n`;
}
