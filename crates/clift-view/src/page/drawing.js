// The map from above, and the marks on the context views.

import { add, scale } from "./camera.js";

const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Sizes a canvas to its box in device pixels; returns its context in CSS pixels. */
function sharp(canvas) {
  const ratio = devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** The corners of a camera's frustum seen from above, in normalized units. */
function frustum(camera, depth) {
  const [fx, , cx] = camera.intrinsics;
  const corner = (u) => add(camera.center, add(scale(camera.axes[2], depth), scale(camera.axes[0], (depth * (u - cx)) / fx)));
  return [camera.center, corner(0), corner(1)].map(([x, , z]) => [x, z]);
}

export class SceneMap {
  constructor(canvas) {
    this.canvas = canvas;
  }

  /** The view that contains all cameras; it follows the own camera only when that leaves it. */
  fit(cameras, own) {
    const points = [...cameras, own].map(({ center: [x, , z] }) => [x, z]);
    const [xs, zs] = [points.map((p) => p[0]), points.map((p) => p[1])];
    const middle = [(Math.min(...xs) + Math.max(...xs)) / 2, (Math.min(...zs) + Math.max(...zs)) / 2];
    const extent = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...zs) - Math.min(...zs), 0.5) + 0.9;
    return { middle: [middle[0], middle[1] + 0.15], extent };
  }

  draw({ context: cameras, frames, keyframes, path, own, current }) {
    const { context, width, height } = sharp(this.canvas);
    const { middle, extent } = this.fit(cameras, own);
    const unit = Math.min(width, height) / extent;
    this.toCanvas = ([x, z]) => [width / 2 + (x - middle[0]) * unit, height / 2 - (z - middle[1]) * unit];
    this.cameras = cameras;
    const dots = (list, radius, fill) => {
      context.fillStyle = fill;
      for (const { center: [x, , z] } of list) {
        context.beginPath();
        context.arc(...this.toCanvas([x, z]), radius, 0, 2 * Math.PI);
        context.fill();
      }
    };
    const shape = (camera, depth, stroke, fill, line) => {
      context.beginPath();
      frustum(camera, depth).forEach((point, i) => context[i ? "lineTo" : "moveTo"](...this.toCanvas(point)));
      context.closePath();
      context.lineWidth = line;
      context.lineJoin = "round";
      context.strokeStyle = stroke;
      if (fill) {
        context.globalAlpha = 0.25;
        context.fillStyle = fill;
        context.fill();
        context.globalAlpha = 1;
      }
      context.stroke();
    };
    dots(frames, 1.6, color("--line"));
    const depth = 26 / unit;
    cameras.forEach((camera, i) => shape(camera, depth * 0.62, i === current ? color("--accent") : color("--soft"), null, 1.3));
    if (path.length > 1) {
      context.beginPath();
      path.forEach(({ center: [x, , z] }, i) => context[i ? "lineTo" : "moveTo"](...this.toCanvas([x, z])));
      context.strokeStyle = color("--mark");
      context.lineWidth = 1.5;
      context.stroke();
    }
    dots(keyframes, 3, color("--mark"));
    shape(own, depth, color("--accent"), color("--accent"), 1.8);
  }

  /** The context camera nearest to a click, as a position in the list. */
  cameraAt(event) {
    if (!this.toCanvas) return -1;
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const gaps = this.cameras.map((camera) => {
      const points = frustum(camera, 0.1).map(this.toCanvas);
      const [px, py] = [0, 1].map((i) => points.reduce((sum, point) => sum + point[i] / 3, 0));
      return Math.hypot(px - x, py - y);
    });
    return gaps.indexOf(Math.min(...gaps));
  }
}

/** A distinct color per cluster: hues by the golden angle. */
const hue = (cluster) => (cluster * 137.508) % 360;

/**
 * Draws a context view with marks. `mode` is none, selected or clusters; `bits` has one bit per stored token.
 */
export function drawContext(canvas, image, scene, view, mode, bits) {
  const side = 160;
  const [width, height] = [side, Math.round((side * image.height) / image.width)];
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.imageSmoothingEnabled = true;
  context.drawImage(image, 0, 0, width, height);
  if (mode === "none") return;
  const [columns, rows] = scene.size.map((pixels) => pixels / scene.patch);
  const [w, h] = [width / columns, height / rows];
  const isSelected = (token) => !bits || (bits[token >> 3] >> (token & 7)) & 1;
  const patches = rows * columns;
  if (mode === "clusters" && scene.clusters) {
    const first = scene.members.indexOf(view) * patches;
    for (let patch = 0; patch < patches; patch++) {
      const token = scene.clusters[first + patch];
      context.fillStyle = `hsl(${hue(token)} 85% 55% / ${isSelected(token) ? 0.55 : 0.12})`;
      context.fillRect((patch % columns) * w, Math.floor(patch / columns) * h, w + 0.5, h + 0.5);
    }
    return;
  }
  context.fillStyle = "rgb(0 0 0 / 55%)";
  context.fillRect(0, 0, width, height);
  scene.tokenIds.forEach((id, token) => {
    if (scene.members[Math.floor(id / patches)] !== view) return;
    const patch = id % patches;
    const [x, y] = [(patch % columns) * w, Math.floor(patch / columns) * h];
    const scaleX = image.width / columns;
    const scaleY = image.height / rows;
    if (isSelected(token)) {
      context.drawImage(image, (patch % columns) * scaleX, Math.floor(patch / columns) * scaleY, scaleX, scaleY, x, y, w, h);
      context.strokeStyle = color("--mark");
    } else {
      context.strokeStyle = "rgb(255 255 255 / 30%)";
    }
    context.lineWidth = Math.max(1, Math.min(2, w * 0.12));
    context.strokeRect(x + 0.5, y + 0.5, w - 1, h - 1);
  });
}
