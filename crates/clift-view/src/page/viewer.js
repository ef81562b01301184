// The viewer: state, requests, replies, and the panel.

import { difference, ofReply, toRows } from "./camera.js";
import { Connection } from "./connection.js";
import { Controls } from "./controls.js";
import { SceneMap, drawContext } from "./drawing.js";
import { CameraPath, PATH_FPS, poseFile } from "./path.js";

/** Milliseconds without a change after which the camera rests. */
const REST_MS = 160;
/** Milliseconds between pictures that belong to one movement. */
const MOVING_MS = 400;
/** Pictures whose times make the displayed rate. */
const RATE_PICTURES = 20;

const $ = (id) => document.getElementById(id);
/** The rendered and the true image in their own pixels; `shown` has them in pixels of the screen. */
const picture = $("picture");
const truth = $("truth");
const shown = $("shown");

const view = {
  hello: null, scene: null, camera: null, distance: 2, dragMode: "orbit", selection: "scaled", precision: null,
  overlay: "none", compareFrame: null, compareMode: "Wipe", comparison: null, bits: null, sceneKey: null,
};
const path = new CameraPath();
const map = new SceneMap($("map"));
const sent = new Map();
let seq = 0;
let drawnSeq = -1;
let restTimer = 0;
let isQueued = false;
let drawnAt = [];
let playing = null;

// ---- Requests ----

function settings() {
  return { tokens: tokenCounts()[$("render").valueAsNumber], selection: view.selection, precision: view.precision };
}

function sendView(rest) {
  if (!view.scene || !connection.isOpen) return;
  seq += 1;
  sent.set(seq, performance.now());
  if (sent.size > 32) sent.delete(sent.keys().next().value);
  const fps = Number($("budget").value);
  connection.send({
    type: "view", seq, c2w: toRows(view.camera), intrinsics: view.camera.intrinsics, ...settings(),
    size: Number($("size").value), budget_ms: fps ? 1000 / fps : null, rest, list_tokens: view.overlay !== "none",
  });
}

/** Renders with the next screen refresh, and in full when nothing changes any more. */
function changed() {
  if (!isQueued) {
    isQueued = true;
    requestAnimationFrame(() => {
      isQueued = false;
      sendView(false);
      drawMap();
    });
  }
  clearTimeout(restTimer);
  restTimer = setTimeout(rest, REST_MS);
}

function rest() {
  drawnAt = [];
  sendView(true);
  requestComparison(view.compareFrame !== null);
  updateCommand();
}

function requestComparison(withImage) {
  if (!view.scene?.frames.length || !connection.isOpen) return;
  const frame = view.compareFrame ?? nearestFrame();
  const isShown = view.comparison?.frame === frame && view.comparison.image;
  connection.send({ type: "compare", frame, ...settings(), image: withImage && !isShown });
}

function nearestFrame() {
  const gaps = view.scene.frames.map((frame) => difference(frame, view.camera));
  return gaps.indexOf(Math.min(...gaps));
}

/** Shows the view of a camera that was not reached by moving: the pivot lies at the scene's distance again. */
function jumpTo(camera) {
  view.distance = view.scene.focus;
  setCamera(camera);
}

function setCamera(camera) {
  if (view.compareFrame !== null) stopComparing();
  view.camera = camera;
  changed();
}

function openScene(scene, stored) {
  stopPlaying();
  connection.send({ type: "open", scene, stored });
}

// ---- Replies ----

async function onReply(header, parts) {
  if (header.type === "hello") onHello(header);
  if (header.type === "scene") await onScene(header, parts);
  if (header.type === "frame") await onFrame(header, parts);
  if (header.type === "comparison") await onComparison(header, parts);
  if (header.type === "failure") notice(header.message, 6000);
}

function onHello(hello) {
  view.hello = hello;
  view.selection = hello.default_selection;
  segments("selection", hello.selections, view.selection, (value) => {
    view.selection = value;
    changed();
  });
  $("precision-row").hidden = hello.precisions.length < 2;
  view.precision = hello.default_precision;
  segments("precision", hello.precisions, view.precision, (value) => {
    view.precision = value;
    changed();
  });
  $("scene-section").hidden = hello.scenes.length < 2;
  $("scene").replaceChildren(...hello.scenes.map((key, i) => new Option(key, i)));
  openScene(view.scene?.index ?? 0, view.scene?.stored ?? null);
}

async function onScene(header, parts) {
  const images = await Promise.all(parts.map((part) => createImageBitmap(new Blob([part], { type: "image/png" }))));
  const isOther = view.sceneKey !== header.key;
  const former = view.scene ? settings().tokens / view.scene.renderable : 1;
  view.sceneKey = header.key;
  view.scene = {
    ...header, index: header.scene, tokenIds: header.token_ids, meanC2w: header.mean_c2w, images,
    context: header.context.map((one) => ({ ...ofReply(one), frame: one.frame })),
    frames: header.frames.map((one) => ({ ...ofReply(one), frame: one.frame })),
  };
  view.distance = header.focus;
  view.bits = null;
  view.comparison = null;
  drawnAt = [];
  fillPanel(header, former);
  if (isOther) {
    stopComparing();
    view.camera = view.scene.context[Math.floor((view.scene.context.length - 1) / 2)];
    path.keyframes = [];
    drawKeyframes();
  }
  if (view.compareFrame !== null) requestComparison(true);
  changed();
}

async function onFrame(header, [bits, bytes]) {
  const image = await createImageBitmap(new Blob([bytes], { type: `image/${header.format}` }));
  connection.send({ type: "ack", seq: header.seq });
  const now = performance.now();
  const started = sent.get(header.seq);
  sent.delete(header.seq);
  if (header.seq <= drawnSeq) return;
  drawnSeq = header.seq;
  [picture.width, picture.height] = header.size;
  picture.getContext("2d").drawImage(image, 0, 0);
  image.close();
  layout();
  drawnAt = now - drawnAt.at(-1) < MOVING_MS ? [...drawnAt.slice(1 - RATE_PICTURES), now] : [now];
  const seconds = (now - drawnAt[0]) / 1000;
  if (!header.rest && drawnAt.length > 4) $("fps").textContent = Math.round((drawnAt.length - 1) / seconds);
  $("ms").textContent = fixed(header.select_ms + header.render_ms);
  if (started) $("latency").textContent = fixed(now - started);
  $("used").textContent = `${header.tokens} of ${header.stored}`;
  $("picture-bytes").textContent = `${header.size.join(" × ")} ${header.format.toUpperCase()}, ${bytesText(bytes.length)}`;
  view.bits = bits.length ? bits : null;
  if (view.overlay !== "none") drawContexts();
  document.documentElement.dataset.picture = `${header.rest ? "rest" : "moving"} ${header.seq} ${header.tokens}`;
}

async function onComparison(header, parts) {
  const image = parts.length ? await createImageBitmap(new Blob([parts[0]], { type: "image/png" })) : null;
  const former = view.comparison?.frame === header.frame ? view.comparison.image : null;
  view.comparison = { frame: header.frame, image: image ?? former };
  $("nearest").textContent = header.camera.frame;
  if (view.compareFrame === null) {
    $("frame").value = header.frame;
    updateLabels();
  }
  $("psnr").textContent = `${header.psnr.toFixed(2)} dB`;
  if (view.compareFrame !== header.frame || !image) return;
  [truth.width, truth.height] = [image.width, image.height];
  truth.getContext("2d").drawImage(image, 0, 0);
  // The exact camera of the frame, with the intrinsics of its image.
  view.camera = ofReply(header.camera);
  $("wipe").hidden = false;
  layout();
  changed();
}

// ---- Drawing ----

/** Places the picture, as large as the stage allows. */
function layout() {
  const stage = $("stage");
  const [width, height] = view.scene?.size ?? [1, 1];
  const unit = Math.min(stage.clientWidth / width, stage.clientHeight / height) * 0.96;
  const [shownWidth, shownHeight] = [width, height].map((side) => Math.max(1, Math.round(side * unit)));
  Object.assign(shown.style, { width: `${shownWidth}px`, height: `${shownHeight}px` });
  const ratio = devicePixelRatio || 1;
  [shown.width, shown.height] = [shownWidth, shownHeight].map((side) => Math.round(side * ratio));
  paint();
  const wipe = $("wipe");
  Object.assign(wipe.style, {
    left: `${shown.offsetLeft}px`, top: `${shown.offsetTop}px`, width: shown.style.width, height: shown.style.height,
  });
  $("wipe-line").style.left = `${$("wipe-at").valueAsNumber / 10}%`;
}

/** Draws the picture in pixels of the screen, with the true image left of the wipe or subtracted. */
function paint() {
  const context = shown.getContext("2d");
  const { width, height } = shown;
  context.imageSmoothingEnabled = !$("pixels").checked;
  context.imageSmoothingQuality = "high"; // bicubic
  context.drawImage(picture, 0, 0, width, height);
  if ($("wipe").hidden) return;
  context.save();
  if (view.compareMode === "Wipe") {
    context.beginPath();
    context.rect(0, 0, (width * $("wipe-at").valueAsNumber) / 1000, height);
    context.clip();
    context.drawImage(truth, 0, 0, width, height);
  } else {
    context.globalCompositeOperation = "difference";
    context.drawImage(truth, 0, 0, width, height);
    // Added to itself twice: four times as bright.
    context.globalCompositeOperation = "lighter";
    for (let i = 0; i < 2; i++) context.drawImage(shown, 0, 0);
  }
  context.restore();
}

function drawMap() {
  if (!view.camera) return;
  const gaps = view.scene.context.map((camera) => difference(camera, view.camera));
  const nearest = gaps.indexOf(Math.min(...gaps));
  const current = gaps[nearest] < 1e-3 ? nearest : -1;
  map.draw({
    context: view.scene.context, frames: view.scene.frames, keyframes: path.keyframes,
    path: path.isMoving ? path.frames() : [], own: view.camera, current,
  });
  [...$("contexts").children].forEach((button, i) => button.setAttribute("aria-current", i === current));
}

function drawContexts() {
  [...$("contexts").querySelectorAll("canvas")].forEach((canvas, i) => {
    drawContext(canvas, view.scene.images[i], view.scene, i, view.overlay, view.bits);
  });
}

function drawKeyframes() {
  const buttons = path.keyframes.map((camera, i) => {
    const button = document.createElement("button");
    button.type = "button";
    button.title = `Go to keyframe ${i + 1}`;
    const remove = document.createElement("span");
    remove.className = "remove";
    remove.textContent = "×";
    remove.title = "Remove";
    remove.onclick = (event) => {
      event.stopPropagation();
      path.keyframes.splice(i, 1);
      drawKeyframes();
    };
    const number = document.createElement("span");
    number.textContent = i + 1;
    button.append(camera.thumbnail, number, remove);
    button.onclick = () => jumpTo(camera);
    return button;
  });
  $("keyframes").replaceChildren(...buttons);
  const count = path.keyframes.length;
  const frames = path.frames().length;
  $("path-facts").textContent = count === 0 ? "no keyframes" : `${count} keyframe${count > 1 ? "s" : ""}, ${frames} frame${frames > 1 ? "s" : ""}`;
  $("play").disabled = !path.isMoving;
  $("clear-path").disabled = count === 0;
  if (view.camera) {
    drawMap();
    updateCommand();
  }
}

// ---- The panel ----

/** Offered token counts: 1, 2, 3, 4, 6, 8, 12, .. up to all. */
function tokenCounts() {
  const { renderable } = view.scene;
  const counts = [];
  for (let power = 1; power < renderable; power *= 2) {
    counts.push(power);
    if (power > 1 && power * 1.5 < renderable) counts.push(power * 1.5);
  }
  return [...counts, renderable];
}

function fillPanel(header, share) {
  const facts = [`${header.context.length} views of ${header.size.join(" × ")}`, `${header.stored} tokens`, bytesText(header.bytes)];
  $("scene-name").textContent = header.key;
  $("scene-name").title = header.key;
  $("scene-facts").textContent = facts.join(" · ");
  $("scene-facts").title = `rendered on ${view.hello.device}, clift ${view.hello.version}`;
  document.title = `${header.key} – clift view`;
  $("scene").value = header.scene;
  const counts = tokenCounts();
  $("render").max = counts.length - 1;
  const wanted = share * header.renderable;
  const gaps = counts.map((count) => Math.abs(Math.log(count / wanted)));
  $("render").value = gaps.indexOf(Math.min(...gaps));
  const stored = $("stored");
  stored.max = header.storage_counts.length - 1;
  stored.value = header.storage_counts.indexOf(header.stored);
  stored.disabled = header.storage_counts.length < 2;
  $("stored-hint").textContent = stored.disabled
    ? `Fixed in the scene file: ${header.tokens}.`
    : `Of ${header.num_patches} patches of the context views; another number encodes the scene again.`;
  const sizes = header.sizes.map((size, i) => new Option(size.join(" × "), i));
  const former = $("size").options.length === sizes.length ? Number($("size").value) : 0;
  $("size").replaceChildren(...sizes);
  $("size").value = former;
  $("compare-section").hidden = header.frames.length === 0;
  $("frame").max = Math.max(0, header.frames.length - 1);
  $("contexts").replaceChildren(...header.context.map((one, i) => {
    const button = document.createElement("button");
    button.type = "button";
    button.title = `Go to context view ${i + 1}, frame ${one.frame}`;
    const number = document.createElement("span");
    number.textContent = `frame ${one.frame}`;
    button.append(document.createElement("canvas"), number);
    button.onclick = () => jumpTo(view.scene.context[i]);
    return button;
  }));
  $("contexts").style.gridTemplateColumns = `repeat(${Math.min(4, header.context.length)}, 1fr)`;
  const clusters = $("overlay").querySelector("[data-value=clusters]");
  clusters.disabled = !header.clusters;
  clusters.title = header.clusters ? "" : "A scene file does not hold the clusters: view the run";
  if (clusters.disabled && view.overlay === "clusters") chooseSegment("overlay", "selected");
  drawContexts();
  updateLabels();
}

function updateLabels() {
  if (!view.scene) return;
  const { renderable, storage_counts: counts } = view.scene;
  labelled("render", `of ${renderable}`, settings().tokens);
  labelled("stored", `of ${view.scene.num_patches}`, counts[$("stored").valueAsNumber]);
  $("seconds-value").textContent = `${path.seconds} s`;
  $("contexts-hint").textContent = {
    none: view.scene.has_true_images ? "The images that were compressed." : "Rendered from all tokens: a scene file holds no images.",
    selected: "Framed: stored tokens; bright: the tokens of this image.",
    clusters: "One color per stored token; strong: the tokens of this image.",
  }[view.overlay];
  for (const slider of document.querySelectorAll("input[type=range]")) {
    slider.style.setProperty("--filled", `${(100 * (slider.value - slider.min)) / Math.max(1, slider.max - slider.min)}%`);
  }
  updateCommand();
}

function labelled(id, rest, number) {
  const strong = document.createElement("b");
  strong.textContent = number;
  $(`${id}-value`).replaceChildren(strong, ` ${rest}`);
}

/** The commands that render the same pictures. */
function commandText() {
  const { scene } = view;
  const { tokens, selection, precision } = settings();
  const size = scene.sizes[Number($("size").value)];
  const words = [scene.render_command, "--path poses.json", "-o frames"];
  if (tokens < scene.renderable) words.push(`--render ${tokens} --selection ${selection}`);
  words.push(`--precision ${precision}`);
  if (size.join() !== scene.size.join()) words.push(`--size ${size.join("x")}`);
  return [scene.encode_command, words.join(" ")].filter(Boolean).join("\n");
}

function updateCommand() {
  if (view.scene) $("command").textContent = commandText();
}

function segments(id, values, current, onChange) {
  const buttons = values.map((value) => {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: value });
    button.setAttribute("role", "radio");
    button.dataset.value = value;
    return button;
  });
  $(id).replaceChildren(...buttons);
  bindSegments(id, current, onChange);
}

function bindSegments(id, current, onChange) {
  $(id).onclick = ({ target }) => {
    if (target.dataset.value) chooseSegment(id, target.dataset.value);
  };
  // Arrows choose the next radio button, as in a radio group of the browser; Tab reaches the chosen one.
  $(id).onkeydown = (event) => {
    const turn = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    const buttons = [...$(id).children];
    const at = buttons.indexOf(event.target);
    if (!turn || at < 0 || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    const next = buttons[(at + turn + buttons.length) % buttons.length];
    next.focus();
    chooseSegment(id, next.dataset.value);
  };
  $(id).choose = onChange;
  mark(id, current);
}

function chooseSegment(id, value) {
  mark(id, value);
  $(id).choose(value);
}

function mark(id, value) {
  for (const button of $(id).children) {
    const isChosen = button.dataset.value === value;
    button.setAttribute("aria-checked", isChosen);
    button.tabIndex = isChosen ? 0 : -1;
  }
}

function notice(text, forMs) {
  $("notice").textContent = text ?? "";
  $("notice").hidden = !text;
  clearTimeout(notice.timer);
  if (text && forMs) notice.timer = setTimeout(() => notice(null), forMs);
}

function fixed(ms) {
  return ms < 10 ? ms.toFixed(1) : ms.toFixed(0);
}

function bytesText(bytes) {
  return bytes < 1e6 ? `${(bytes / 1e3).toFixed(1)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}

// ---- Comparing, playing, exporting ----

function startComparing(frame) {
  if (!view.scene?.frames.length) return;
  stopPlaying();
  view.compareFrame = frame;
  view.comparison = null;
  $("frame").value = frame;
  $("compare").setAttribute("aria-pressed", "true");
  requestComparison(true);
  updateLabels();
}

function stopComparing() {
  view.compareFrame = null;
  $("wipe").hidden = true;
  paint();
  $("compare").setAttribute("aria-pressed", "false");
}

function toggleComparing() {
  if (view.compareFrame === null) startComparing(nearestFrame());
  else stopComparing();
}

function addKeyframe() {
  if (!view.scene) return;
  const thumbnail = document.createElement("canvas");
  Object.assign(thumbnail, { width: 120, height: 120 });
  const side = Math.min(picture.width, picture.height);
  const [x, y] = [(picture.width - side) / 2, (picture.height - side) / 2];
  thumbnail.getContext("2d").drawImage(picture, x, y, side, side, 0, 0, 120, 120);
  path.keyframes.push({ ...view.camera, thumbnail });
  drawKeyframes();
}

function startPlaying() {
  if (!path.isMoving) return;
  const started = performance.now();
  const step = (now) => {
    const share = Math.max(0, now - started) / 1000 / path.seconds;
    setCamera(path.at(Math.min(1, share)));
    if (share < 1) playing = requestAnimationFrame(step);
    else stopPlaying();
  };
  playing = requestAnimationFrame(step);
  $("play").textContent = "Stop";
}

function stopPlaying() {
  cancelAnimationFrame(playing);
  playing = null;
  $("play").textContent = "Play";
}

function togglePlaying() {
  if (playing === null) startPlaying();
  else stopPlaying();
}

/** Saves the path, or the current camera if there are no keyframes. */
function exportPath() {
  if (!view.scene) return;
  const frames = path.keyframes.length ? path.frames() : [view.camera];
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([poseFile(frames, view.scene)], { type: "application/json" }));
  link.download = "poses.json";
  link.click();
  URL.revokeObjectURL(link.href);
  notice(frames.length > 1 ? `poses.json: ${frames.length} cameras, ${frames.length / PATH_FPS} s` : "poses.json: this camera", 2500);
}

async function copyCommand() {
  const text = $("command").textContent;
  try {
    await navigator.clipboard.writeText(text);
    notice("Command copied", 1800);
  } catch {
    // Without HTTPS only localhost has a clipboard.
    getSelection().selectAllChildren($("command"));
    notice("Press Ctrl-C to copy the marked command", 3000);
  }
}

function goHome() {
  if (!view.scene) return;
  const gaps = view.scene.context.map((camera) => difference(camera, view.camera));
  jumpTo(view.scene.context[gaps.indexOf(Math.min(...gaps))]);
}

function stepTokens(by) {
  $("render").value = $("render").valueAsNumber + by;
  $("render").dispatchEvent(new Event("input"));
}

// ---- Wiring ----

const KEYS = {
  "[": () => stepTokens(-1), "]": () => stepTokens(1), r: goHome, k: addKeyframe, c: toggleComparing, t: toggleTheme,
  " ": togglePlaying, "?": () => $("help").showModal(),
};

function toggleTheme() {
  applyTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark", true);
}

function applyTheme(theme, isChosen) {
  document.documentElement.dataset.theme = theme;
  if (isChosen) localStorage.setItem("theme", theme);
  if (view.camera) {
    drawMap();
    drawContexts();
  }
}

const darkness = matchMedia("(prefers-color-scheme: dark)");
const systemTheme = () => (darkness.matches ? "dark" : "light");
applyTheme(localStorage.getItem("theme") ?? systemTheme(), false);
darkness.onchange = () => localStorage.getItem("theme") ?? applyTheme(systemTheme(), false);

bindSegments("drag-mode", view.dragMode, (value) => {
  view.dragMode = value;
});
bindSegments("overlay", view.overlay, (value) => {
  view.overlay = value;
  updateLabels();
  drawContexts();
  changed();
});
$("render").oninput = () => {
  updateLabels();
  if (view.compareFrame !== null) requestComparison(false);
  changed();
};
$("stored").oninput = updateLabels;
$("stored").onchange = () => openScene(view.scene.index, view.scene.storage_counts[$("stored").valueAsNumber]);
$("scene").onchange = () => openScene(Number($("scene").value), view.scene.storage_counts.length > 1 ? view.scene.stored : null);
const stepScene = (by) => {
  const count = view.hello.scenes.length;
  $("scene").value = (Number($("scene").value) + by + count) % count;
  $("scene").onchange();
};
$("scene-before").onclick = () => stepScene(-1);
$("scene-after").onclick = () => stepScene(1);
$("budget").onchange = changed;
$("size").onchange = () => {
  updateCommand();
  changed();
};
$("pixels").onchange = paint;
segments("compare-mode", ["Wipe", "Difference"], view.compareMode, (value) => {
  view.compareMode = value;
  $("wipe").classList.toggle("difference", value === "Difference");
  paint();
});
$("compare").onclick = toggleComparing;
$("frame").oninput = () => startComparing($("frame").valueAsNumber);
$("wipe-at").oninput = layout;
$("home").onclick = goHome;
$("theme").onclick = toggleTheme;
$("help-button").onclick = () => $("help").showModal();
$("add-keyframe").onclick = addKeyframe;
$("play").onclick = togglePlaying;
$("clear-path").onclick = () => {
  path.keyframes = [];
  drawKeyframes();
};
$("seconds").oninput = () => {
  path.seconds = $("seconds").valueAsNumber;
  updateLabels();
  drawKeyframes();
};
$("export").onclick = exportPath;
$("copy-command").onclick = copyCommand;
$("map").onclick = (event) => {
  const i = view.scene ? map.cameraAt(event) : -1;
  if (i >= 0) jumpTo(view.scene.context[i]);
};
new ResizeObserver(() => {
  layout();
  drawMap();
}).observe($("stage"));
addEventListener("keydown", (event) => {
  const isField = event.target.closest?.("input:not([type=range]), select, dialog");
  // A button in focus takes the keys that press it.
  const isPressed = event.target.closest?.("button") && (event.key === " " || event.key === "Enter");
  if (isField || isPressed || event.ctrlKey || event.metaKey || event.altKey || !view.scene) return;
  const context = /^[1-9]$/.test(event.key) ? view.scene.context[event.key - 1] : null;
  const action = context ? () => jumpTo(context) : KEYS[event.key.toLowerCase()];
  if (!action) return;
  event.preventDefault();
  action();
});
new Controls($("stage"), view, (camera) => {
  stopPlaying();
  setCamera(camera);
});

// The token is in the cookie now; a copied address should not hold it.
history.replaceState(null, "", "/");
const connection = new Connection(onReply, (text) => notice(text));
