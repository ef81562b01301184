// Mouse, touch and keys on the stage.

import { look, move, orbit } from "./camera.js";

const TURN_PER_PX = 0.006;
const FLY_PER_S = 0.6;
const LOOK_PER_S = 0.9;
const MOVES = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0] };
const LOOKS = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, 1], arrowdown: [0, -1] };

export class Controls {
  /** `view` has `camera`, `distance` to the pivot, `dragMode`; `onMove(camera)` gets the changed camera. */
  constructor(stage, view, onMove) {
    this.stage = stage;
    this.view = view;
    this.onMove = onMove;
    this.pointers = new Map();
    this.keys = new Set();
    this.frame = 0;
    stage.addEventListener("pointerdown", (event) => this.pointerDown(event));
    stage.addEventListener("pointermove", (event) => this.pointerMove(event));
    for (const type of ["pointerup", "pointercancel"]) stage.addEventListener(type, (event) => this.pointerUp(event));
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    stage.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    addEventListener("keydown", (event) => this.keyDown(event));
    addEventListener("keyup", (event) => this.release(event.key.toLowerCase()));
    addEventListener("blur", () => this.keys.clear());
    for (const button of document.querySelectorAll("#move-pad button")) {
      button.addEventListener("pointerdown", (event) => {
        event.stopPropagation();
        button.setPointerCapture(event.pointerId);
        this.press(button.dataset.key);
      });
      for (const type of ["pointerup", "pointercancel"]) {
        button.addEventListener(type, () => this.release(button.dataset.key));
      }
    }
  }

  pointerDown(event) {
    if (!this.view.camera || event.target.closest("button, input, #map")) return;
    this.stage.focus({ preventScroll: true });
    this.stage.setPointerCapture(event.pointerId);
    this.stage.classList.add("dragging");
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  pointerMove(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    const [dx, dy] = [now.x - before.x, now.y - before.y];
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    this.pointers.set(event.pointerId, now);
    const { camera, distance, dragMode } = this.view;
    const perPx = distance / this.stage.clientHeight;
    if (other) {
      const gap = (point) => Math.hypot(point.x - other.x, point.y - other.y);
      const forward = (gap(now) - gap(before)) * perPx * 2;
      this.onMove(move(camera, [-dx * perPx, -dy * perPx, forward]));
    } else if (event.shiftKey || event.buttons & 6) {
      this.onMove(move(camera, [-dx * perPx, -dy * perPx, 0]));
    } else {
      const [yaw, pitch] = [dx * TURN_PER_PX, -dy * TURN_PER_PX];
      // The scene follows the pointer in both modes: around the pivot, or opposite to the turn in place.
      this.onMove(dragMode === "orbit" ? orbit(camera, distance, yaw, pitch) : look(camera, -yaw / 2, -pitch / 2));
    }
  }

  pointerUp(event) {
    this.pointers.delete(event.pointerId);
    if (this.pointers.size === 0) this.stage.classList.remove("dragging");
  }

  wheel(event) {
    event.preventDefault();
    if (!this.view.camera) return;
    const lines = event.deltaMode === 1 ? 16 : 1;
    const turned = Math.max(-100, Math.min(100, event.deltaY * lines)) * 0.0015;
    const { camera, distance, dragMode } = this.view;
    // The pivot of an orbit stays where it is: the camera comes nearer to it and never passes it.
    const left = dragMode === "orbit" ? distance * Math.exp(turned) : distance;
    const forward = dragMode === "orbit" ? distance - left : -turned * distance;
    this.view.distance = left;
    this.onMove(move(camera, [0, 0, forward]));
  }

  keyDown(event) {
    const isField = event.target.closest?.("input:not([type=range]), select, textarea, dialog");
    if (isField || event.ctrlKey || event.metaKey || event.altKey) return;
    const key = event.key.toLowerCase();
    // Arrows move a slider in focus, and choose a radio button.
    if (event.target.matches?.("input[type=range], [role=radio]") && LOOKS[key]) return;
    this.isFast = event.shiftKey;
    if (!MOVES[key] && !LOOKS[key]) return;
    event.preventDefault();
    this.press(key);
  }

  press(key) {
    this.keys.add(key);
    if (!this.frame) {
      this.last = performance.now();
      this.frame = requestAnimationFrame((now) => this.fly(now));
    }
  }

  release(key) {
    this.keys.delete(key);
  }

  /** Moves while keys are held; no frame is requested otherwise. */
  fly(now) {
    this.frame = 0;
    if (this.keys.size === 0 || !this.view.camera) return;
    const seconds = Math.min(0.1, Math.max(0, (now - this.last) / 1000));
    this.last = now;
    let camera = this.view.camera;
    const speed = FLY_PER_S * (this.isFast ? 3 : 1) * seconds;
    for (const key of this.keys) {
      if (MOVES[key]) camera = move(camera, MOVES[key].map((v) => v * speed));
      if (LOOKS[key]) camera = look(camera, LOOKS[key][0] * LOOK_PER_S * seconds, LOOKS[key][1] * LOOK_PER_S * seconds);
    }
    this.onMove(camera);
    this.frame = requestAnimationFrame((later) => this.fly(later));
  }
}
