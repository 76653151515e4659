"use strict";
/* Turns a model of many scans; drawing itself is page_draw.js. */
(() => {
  const byId = (id) => document.getElementById(id);
  const data = JSON.parse(byId("data").textContent), stage = byId("stage");
  const wish = new URLSearchParams(location.search.slice(1));
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const floats = (text) => new Float32Array(bytes(text).buffer);
  const parseColor = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));
  const STILL = Float64Array.of(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);

  /* ---------- what is drawn ---------- */
  const clouds = {};
  for (const { name, color, points } of data.clouds) {
    const cloud = { points: floats(points) }, paint = parseColor(color);
    cloud.colors = new Uint8Array(cloud.points.length);
    for (let i = 0; i < cloud.points.length; i += 3) cloud.colors.set(paint, i);
    clouds[name] = cloud;
  }
  const vertices = floats(data.lines.vertices), numLines = vertices.length / 6;
  const lines = { vertices, colors: new Uint8Array(6 * numLines), ends: new Float32Array(2 * numLines), ranges: [] };
  let first = 0;
  for (const kind of data.lines.classes) {
    lines.ranges.push([first, kind.drawn]);
    const color = parseColor(kind.color);
    for (let i = 6 * first; i < 6 * (first + kind.drawn); i++) lines.colors[i] = color[i % 3];
    first += kind.drawn;
  }
  for (let i = 0; i < numLines; i++) lines.ends[2 * i + 1] = 1;

  /* ---------- camera ---------- */
  const FIELD = 40 * Math.PI / 180;
  const SIDES = { home: [-0.6, 0.6], top: [0, Math.PI / 2], front: [0, 0], side: [Math.PI / 2, 0] };
  const [right, forward, up] = data.axes;
  const state = {
    yaw: -0.6, pitch: 0.6, distance: 1, center: [0, 0, 0], fitted: true, size: 0, cut: 0,
    hidden: new Set(), classes: data.lines.classes.map((kind) => kind.shown),
  };
  function axesOfCamera() {
    const [cy, sy, cp, sp] = [Math.cos(state.yaw), Math.sin(state.yaw), Math.cos(state.pitch), Math.sin(state.pitch)];
    const across = right.map((v, i) => cy * v + sy * forward[i]);
    const level = forward.map((v, i) => cy * v - sy * right[i]);
    return [across, level.map((v, i) => sp * v + cp * up[i]), level.map((v, i) => cp * v - sp * up[i])];
  }
  function cameraMatrices(width, height) {
    const [across, above, look] = axesOfCamera();
    const eye = state.center.map((v, i) => v - state.distance * look[i]);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const view = Float64Array.of(
      across[0], above[0], -look[0], 0, across[1], above[1], -look[1], 0, across[2], above[2], -look[2], 0,
      -dot(across, eye), -dot(above, eye), dot(look, eye), 1);
    const open = state.cut ? state.distance + (2.2 * state.cut - 1.1) * data.radius : 0;
    const near = Math.max(0.02 * state.distance, 1e-4 * data.radius, open), far = state.distance + 40 * data.radius;
    const focal = 1 / Math.tan(FIELD / 2), projection = new Float64Array(16);
    projection[0] = focal * height / width;
    projection[5] = focal;
    projection[10] = (far + near) / (near - far);
    projection[11] = -1;
    projection[14] = 2 * far * near / (near - far);
    return { view, projection, near, far, pixelsPerUnit: focal * height / 2 };
  }
  function fit() {
    const narrow = Math.min(1, stage.clientWidth / Math.max(1, stage.clientHeight));
    state.center = [0, 0, 0];
    state.distance = 1.05 * data.radius / Math.sin(FIELD / 2) / narrow;
  }
  function goTo(side) { [state.yaw, state.pitch] = SIDES[side]; state.fitted = true; invalidate(); }
  function turn(dx, dy) {
    state.yaw -= dx;
    state.pitch = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, state.pitch + dy));
    invalidate();
  }
  function move(dx, dy) {
    state.fitted = false;
    const unit = 2 * state.distance * Math.tan(FIELD / 2) / Math.max(1, stage.clientHeight);
    const [across, above] = axesOfCamera();
    state.center = state.center.map((v, i) => v + unit * (-dx * across[i] + dy * above[i]));
    invalidate();
  }
  function zoom(factor) {
    state.fitted = false;
    state.distance = Math.min(40 * data.radius, Math.max(0.02 * data.radius, state.distance * factor));
    invalidate();
  }

  /* ---------- drawing ---------- */
  let renderer = null, canvas = null, waiting = false, checked = false;
  function ground() {
    const probe = document.createElement("i");
    probe.style.color = "var(--stage)";
    stage.append(probe);
    const found = getComputedStyle(probe).color.match(/[\d.]+/g).slice(0, 3).map(Number);
    probe.remove();
    return found;
  }
  function start(Kind) {
    if (canvas) canvas.remove();
    canvas = document.createElement("canvas");
    canvas.setAttribute("aria-hidden", "true");
    stage.prepend(canvas);
    renderer = new Kind(canvas, clouds, lines);
    document.body.dataset.renderer = renderer.kind;
    canvas.addEventListener("webglcontextlost", () => startPlain("the graphics card was lost"));
  }
  function startPlain(why) {
    start(PlainRenderer);
    byId("notice").textContent = `Drawn without a graphics card (${why}): slower, otherwise the same.`;
    byId("notice").hidden = false;
    invalidate();
  }
  function invalidate() {
    if (!waiting) { waiting = true; requestAnimationFrame(draw); }
  }
  function draw() {
    waiting = false;
    if (state.fitted) fit();
    const ratio = Math.min(renderer.kind === "webgl2" ? 2 : 1, window.devicePixelRatio || 1);
    const width = Math.max(1, Math.round(stage.clientWidth * ratio)), height = Math.max(1, Math.round(stage.clientHeight * ratio));
    const shown = Object.keys(clouds).filter((name) => !state.hidden.has(name)), background = ground();
    renderer.draw({ ...cameraMatrices(width, height), model: STILL, clouds: shown.map((name) => ({ name, model: STILL })),
      classes: state.classes, background, diameter: 0.8 * data.spacing * 2 ** state.size }, width, height, ratio);
    const num = shown.reduce((sum, name) => sum + clouds[name].points.length / 3, 0);
    if (!checked) {
      checked = true;
      const covered = renderer.covered(background);
      document.body.dataset.covered = covered.toFixed(4);
      if (covered === 0 && num > 0 && renderer.kind === "webgl2") { // a driver that accepts everything and draws nothing
        checked = false;
        startPlain("it drew nothing");
        return;
      }
    }
    document.body.dataset.drawnPoints = String(num);
    document.body.dataset.drawnLines = String(state.classes.reduce((sum, on, i) => sum + (on ? lines.ranges[i][1] : 0), 0));
    document.body.dataset.ready = "true";
  }

  /* ---------- pointer, wheel, keys ---------- */
  const fingers = new Map();
  stage.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    stage.setPointerCapture(event.pointerId);
    stage.focus({ preventScroll: true });
  });
  stage.addEventListener("pointermove", (event) => {
    const old = fingers.get(event.pointerId);
    if (!old) return;
    const now = [event.clientX, event.clientY], dx = now[0] - old[0], dy = now[1] - old[1];
    if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const span = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      zoom(Math.max(1, span(old)) / Math.max(1, span(now)));
      move(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 6) move(dx, dy);
    else turn(dx * 0.007, dy * 0.007);
    fingers.set(event.pointerId, now);
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    stage.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaMode === 1 ? 18 * event.deltaY : event.deltaY)) * 0.0025));
  }, { passive: false });
  stage.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const arrows = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (arrows[event.key]) {
      const [x, y] = arrows[event.key];
      if (event.shiftKey) move(30 * x, 30 * y);
      else turn(0.09 * x, 0.09 * y);
    } else if (event.key === "+" || event.key === "=") zoom(0.87);
    else if (event.key === "-" || event.key === "_") zoom(1.15);
    else if ("0123".includes(event.key)) goTo(["home", "top", "front", "side"][Number(event.key)]);
    else return;
    event.preventDefault();
  });

  /* ---------- controls ---------- */
  document.querySelectorAll("[data-side]").forEach((button) => button.addEventListener("click", () => goTo(button.dataset.side)));
  for (const name of ["size", "cut"]) {
    byId(name).addEventListener("input", (event) => { state[name] = Number(event.target.value); invalidate(); });
  }
  const boxes = [...document.querySelectorAll("[data-scan]")];
  function show(box, on) {
    box.checked = on;
    if (on) state.hidden.delete(box.dataset.scan);
    else state.hidden.add(box.dataset.scan);
    invalidate();
  }
  boxes.forEach((box) => box.addEventListener("change", () => show(box, box.checked)));
  byId("all").addEventListener("click", () => boxes.forEach((box) => show(box, true)));
  byId("none").addEventListener("click", () => boxes.forEach((box) => show(box, false)));
  data.lines.classes.forEach((kind, i) => {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox";
    box.checked = state.classes[i];
    box.addEventListener("change", () => { state.classes[i] = box.checked; invalidate(); });
    const words = document.createElement("span");
    words.textContent = ` ${kind.label} (${kind.drawn})`;
    words.style.color = kind.color;
    label.append(box, words);
    byId("classes").append(label);
  });

  /* ---------- begin ---------- */
  try {
    if (wish.get("renderer") === "canvas2d") throw new Error("as asked");
    start(CardRenderer);
  } catch (problem) {
    startPlain(problem.message);
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", invalidate);
  new ResizeObserver(invalidate).observe(stage);
  goTo(SIDES[wish.get("side")] ? wish.get("side") : "home");
})();
