// Cameras in the normalized frame of the scene. OpenCV axes: +x right, +y down, +z forward.
// A pose is { axes: [right, down, forward], center }, a camera a pose with intrinsics fx, fy, cx, cy over width and height.

export const add = (a, b) => a.map((v, i) => v + b[i]);
export const scale = (a, s) => a.map((v) => v * s);
export const sub = (a, b) => a.map((v, i) => v - b[i]);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const length = (a) => Math.hypot(...a);
const unit = (a) => scale(a, 1 / length(a));

/** The vertical axis of the mean context view, which is upright in the frame. */
const DOWN = [0, 1, 0];
/** Largest cosine between viewing direction and the vertical. */
const STEEPEST = 0.98;

export function ofReply({ c2w, intrinsics }) {
  const column = (i) => [c2w[i], c2w[4 + i], c2w[8 + i]];
  return { axes: [column(0), column(1), column(2)], center: column(3), intrinsics: [...intrinsics] };
}

/** The first three rows of the camera-to-world matrix. */
export function toRows({ axes: [x, y, z], center }) {
  return [0, 1, 2].flatMap((i) => [x[i], y[i], z[i], center[i]]);
}

/** The rows of the camera-to-world matrix in the world of the capture. */
export function toWorldRows(camera, meanC2w, worldScale) {
  const turn = (v) => [0, 1, 2].map((row) => dot([0, 1, 2].map((i) => meanC2w[row * 4 + i]), v));
  const mean = [3, 7, 11].map((i) => meanC2w[i]);
  const [x, y, z] = camera.axes.map(turn);
  const center = add(turn(scale(camera.center, 1 / worldScale)), mean);
  return [0, 1, 2].map((i) => [x[i], y[i], z[i], center[i]]);
}

/** Rotates a vector about a unit axis (Rodrigues). */
function rotated(v, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add(scale(v, c), scale(cross(axis, v), s)), scale(axis, dot(axis, v) * (1 - c)));
}

/** Rounding adds up over many small turns. */
function orthonormal([x, y, z]) {
  const forward = unit(z);
  const right = unit(sub(x, scale(forward, dot(x, forward))));
  return [right, cross(forward, right), forward];
}

/** Turns a camera about a pivot: `yaw` about the vertical, `pitch` about its own right axis, in radians. */
function turnedAbout(camera, pivot, yaw, pitch) {
  const about = (one, axis, angle) => ({
    ...one,
    axes: orthonormal(one.axes.map((v) => rotated(v, axis, angle))),
    center: add(pivot, rotated(sub(one.center, pivot), axis, angle)),
  });
  const turned = about(camera, DOWN, yaw);
  const pitched = about(turned, turned.axes[0], pitch);
  const steepness = (one) => Math.abs(dot(one.axes[2], DOWN));
  return steepness(pitched) > STEEPEST && steepness(pitched) > steepness(turned) ? turned : pitched;
}

export const look = (camera, yaw, pitch) => turnedAbout(camera, camera.center, yaw, pitch);

export function orbit(camera, distance, yaw, pitch) {
  return turnedAbout(camera, add(camera.center, scale(camera.axes[2], distance)), yaw, pitch);
}

/** Moves along the camera's own axes. */
export function move(camera, [right, down, forward]) {
  const [x, y, z] = camera.axes;
  const step = add(add(scale(x, right), scale(y, down)), scale(z, forward));
  const center = add(camera.center, step).map((v) => Math.max(-100, Math.min(100, v)));
  return { ...camera, center };
}

/** How far two cameras are apart: distance in normalized units, plus the angle in radians. */
export function difference(a, b) {
  const angle = Math.acos(Math.max(-1, Math.min(1, dot(a.axes[2], b.axes[2]))));
  return length(sub(a.center, b.center)) + angle;
}

function quaternion({ axes: [[xx, yx, zx], [xy, yy, zy], [xz, yz, zz]] }) {
  const squares = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz];
  const largest = squares.indexOf(Math.max(...squares));
  const q = [
    [squares[0], zy - yz, xz - zx, yx - xy],
    [zy - yz, squares[1], xy + yx, xz + zx],
    [xz - zx, xy + yx, squares[2], yz + zy],
    [yx - xy, xz + zx, yz + zy, squares[3]],
  ][largest];
  return scale(q, 1 / length(q));
}

function axesOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
}

function slerp(a, b, t) {
  let cosine = a.reduce((sum, v, i) => sum + v * b[i], 0);
  const near = cosine < 0 ? scale(b, -1) : b;
  cosine = Math.abs(cosine);
  const angle = Math.acos(Math.min(1, cosine));
  const [p, q] = angle < 1e-6 ? [1 - t, t] : [Math.sin((1 - t) * angle) / Math.sin(angle), Math.sin(t * angle) / Math.sin(angle)];
  return unit(add(scale(a, p), scale(near, q)));
}

/**
 * The camera at `time` in [0, cameras.length - 1] of a smooth path: Catmull-Rom centers, spherically interpolated
 * orientations, linear intrinsics; the rule of `clift render --path interpolate`.
 */
export function pathAt(cameras, time) {
  const last = cameras.length - 1;
  const first = Math.min(Math.floor(time), Math.max(last - 1, 0));
  const t = time - first;
  const at = (i) => cameras[Math.max(0, Math.min(last, i))];
  const [before, from, to, after] = [at(first - 1), at(first), at(first + 1), at(first + 2)];
  const center = from.center.map((b, i) => {
    const [a, c, d] = [before.center[i], to.center[i], after.center[i]];
    return b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)));
  });
  const axes = axesOf(slerp(quaternion(from), quaternion(to), t));
  const intrinsics = from.intrinsics.map((v, i) => v + t * (to.intrinsics[i] - v));
  return { axes, center, intrinsics };
}
