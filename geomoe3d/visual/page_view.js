"use strict";
/* What every page with clouds to turn does alike: it unpacks its data, looks from a camera that pointer, wheel
   and keys move, and finds a renderer of page_draw.js that works. What is shown is the page's own. */

const STILL = Float64Array.of(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);

/* ---------- trouble is told ---------- */
function say(text) { // the report has no place for notices
  const notice = document.getElementById("notice");
  if (!notice) return;
  notice.textContent = text;
  notice.hidden = false;
}
function report(problem) {
  document.body.dataset.error = String((problem && problem.message) || problem);
  say("The 3D view failed: " + document.body.dataset.error);
}
window.addEventListener("error", (event) => report(event.error || event.message));
window.addEventListener("unhandledrejection", (event) => report(event.reason));

/* ---------- data ---------- */
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const floats = (text) => new Float32Array(bytes(text).buffer);
const parseColor = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));
const styleColor = (name) => parseColor(getComputedStyle(document.documentElement).getPropertyValue(name).trim());

function oneColor(length, color) {
  const colors = new Uint8Array(length);
  for (let i = 0; i < length; i += 3) colors.set(color, i);
  return colors;
}
function unpackLines({ vertices, classes }) {
  const places = floats(vertices), num = places.length / 6, colors = new Uint8Array(6 * num), ranges = [];
  let first = 0;
  for (const { color, drawn } of classes) {
    ranges.push([first, drawn]);
    colors.set(oneColor(6 * drawn, parseColor(color)), 6 * first);
    first += drawn;
  }
  return { vertices: places, ends: Float32Array.from({ length: 2 * num }, (_, i) => i % 2), colors, ranges };
}

/* Every so many points of a cloud, about a thousand, under a motion: what a camera is fitted to. */
function sample(points, model = STILL) {
  const step = 3 * Math.max(1, Math.floor(points.length / 3000)), num = Math.ceil(points.length / step);
  const found = new Float64Array(3 * num);
  for (let i = 0; i < num; i++) for (let k = 0; k < 3; k++) {
    let sum = model[12 + k];
    for (let j = 0; j < 3; j++) sum += model[4 * j + k] * points[step * i + j];
    found[3 * i + k] = sum;
  }
  return found;
}

/* ---------- camera ---------- */
const FIELD = 40 * Math.PI / 180;
const SIDES = { top: [0, Math.PI / 2], front: [0, 0], side: [Math.PI / 2, 0] }; // yaw and pitch

/** Sees a stage's clouds from a distance to their middle. */
class Camera {
  /* axes: right, forward, up; radius: half the size of what is shown; sides: name -> yaw and pitch, the first to
     begin with; limits of the distance and margin when fitted, in radii; changed: called after every change. */
  constructor(stage, { axes, radius, sides, limits = [0.02, 40], margin = 1.05, changed }) {
    Object.assign(this, { stage, axes, radius, sides, limits, margin, changed });
    Object.assign(this, { distance: 1, center: [0, 0, 0], fitted: true, cut: 0 });
    [this.yaw, this.pitch] = this.begun = Object.values(sides)[0];
  }

  directions(yaw = this.yaw, pitch = this.pitch) {
    const [right, forward, up] = this.axes;
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    const level = forward.map((v, i) => cy * v - sy * right[i]);
    return {
      across: right.map((v, i) => cy * v + sy * forward[i]),
      above: level.map((v, i) => sp * v + cp * up[i]),
      look: level.map((v, i) => cp * v - sp * up[i]), // into the picture
    };
  }

  matrices(width, height) {
    const { across, above, look } = this.directions(), { distance, radius, cut } = this;
    const eye = this.center.map((v, i) => v - distance * look[i]);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const view = Float64Array.of(
      across[0], above[0], -look[0], 0, across[1], above[1], -look[1], 0, across[2], above[2], -look[2], 0,
      -dot(across, eye), -dot(above, eye), dot(look, eye), 1);
    const open = cut ? distance + (2.2 * cut - 1.1) * radius : 0;
    const near = Math.max(0.02 * distance, 1e-4 * radius, open), far = distance + this.limits[1] * radius;
    const focal = 1 / Math.tan(FIELD / 2), projection = new Float64Array(16);
    projection[0] = focal * height / width;
    projection[5] = focal;
    projection[10] = (far + near) / (near - far);
    projection[11] = -1;
    projection[14] = 2 * far * near / (near - far);
    return { view, projection, near, far, pixelsPerUnit: focal * height / 2 };
  }

  /* Brings a ball into view; then, of points [x, y, z, ...] if given, all but a few strays as they look from the side
     last chosen, so that nothing is cut off and turning does not zoom. */
  fit(center, radius, points = null) {
    const { clientWidth, clientHeight } = this.stage;
    const aspect = Math.max(1, clientWidth) / Math.max(1, clientHeight);
    this.center = center;
    this.distance = this.margin * radius / Math.sin(FIELD / 2) / Math.min(1, aspect);
    if (!points || points.length < 30) return;
    const { across, above, look } = this.directions(...this.begun), half = Math.tan(FIELD / 2) / (1.03 * this.margin);
    const middle = (values) => {
      values.sort();
      const few = Math.floor(values.length / 1000);
      return [values[few], values[values.length - 1 - few]];
    };
    for (let turn = 0; turn < 8; turn++) {
      const u = new Float64Array(points.length / 3), v = u.slice(), [cx, cy, cz] = this.center;
      for (let i = 0; i < u.length; i++) {
        const x = points[3 * i] - cx, y = points[3 * i + 1] - cy, z = points[3 * i + 2] - cz;
        const depth = Math.max(0.05 * radius, this.distance + x * look[0] + y * look[1] + z * look[2]);
        u[i] = (x * across[0] + y * across[1] + z * across[2]) / depth;
        v[i] = (x * above[0] + y * above[1] + z * above[2]) / depth;
      }
      const [[left, right], [low, high]] = [middle(u), middle(v)], before = this.distance;
      this.center = this.center.map((c, k) => c + before / 2 * ((left + right) * across[k] + (low + high) * above[k]));
      this.distance *= Math.max((right - left) / (2 * half * aspect), (high - low) / (2 * half), 0.05);
      this.distance = Math.max(this.distance, 2.2 * radius); // from nearer, what is in front looks huge
    }
  }

  goTo(side) {
    [this.yaw, this.pitch] = this.begun = this.sides[side] || Object.values(this.sides)[0];
    this.fitted = true;
    this.changed();
  }

  turn(dx, dy) {
    this.yaw -= dx;
    this.pitch = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, this.pitch + dy));
    this.changed();
  }

  move(dx, dy) { // in pixels of the stage
    const unit = 2 * this.distance * Math.tan(FIELD / 2) / Math.max(1, this.stage.clientHeight);
    const { across, above } = this.directions();
    this.fitted = false;
    this.center = this.center.map((v, i) => v + unit * (-dx * across[i] + dy * above[i]));
    this.changed();
  }

  zoom(factor) {
    const [nearest, farthest] = this.limits;
    this.fitted = false;
    this.distance = Math.min(farthest * this.radius, Math.max(nearest * this.radius, this.distance * factor));
    this.changed();
  }

  /* Digits for the sides, in their order. */
  sideKeys() {
    return Object.fromEntries(Object.keys(this.sides).map((side, i) => [i, () => this.goTo(side)]));
  }
}

/* ---------- pointer, wheel, keys ---------- */
/* Lets the hand move a camera: on its stage, and by the buttons of the sides in `element`. perPixel: angle of a drag;
   keys: what further keys do; wheels: whether the wheel is for this stage just now. */
function listen(camera, { element = document, perPixel = 0.007, keys = {}, wheels = () => true }) {
  const { stage } = camera, fingers = new Map();
  stage.addEventListener("pointerdown", (event) => {
    if (event.target !== stage && event.target.tagName !== "CANVAS") return; // words on the stage can be marked
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
      camera.zoom(Math.max(1, span(old)) / Math.max(1, span(now)));
      camera.move(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 6) camera.move(dx, dy);
    else camera.turn(dx * perPixel, dy * perPixel);
    fingers.set(event.pointerId, now);
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    stage.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("wheel", (event) => {
    if (!wheels()) return;
    event.preventDefault();
    const step = event.deltaMode === 1 ? 18 * event.deltaY : event.deltaY; // lines or pixels
    camera.zoom(Math.exp(Math.max(-60, Math.min(60, step)) * 0.0025));
  }, { passive: false });
  stage.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const arrow = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (arrow) {
      if (event.shiftKey) camera.move(30 * arrow[0], 30 * arrow[1]);
      else camera.turn(0.09 * arrow[0], 0.09 * arrow[1]);
    } else if (event.key === "+" || event.key === "=") camera.zoom(0.87);
    else if (event.key === "-" || event.key === "_") camera.zoom(1.15);
    else if (keys[event.key]) keys[event.key]();
    else return;
    event.preventDefault();
  });
  element.querySelectorAll("[data-side]").forEach((button) =>
    button.addEventListener("click", () => camera.goTo(button.dataset.side)));
}

/* ---------- canvas ---------- */
/** A canvas and its renderer: WebGL 2, or a plain canvas where that fails, be it at once or later. */
class Display {
  /* draw(time): called in the frame after `invalidate`; repaint: called when colours or renderer have changed;
     stage: takes the canvas in; without one it stays out of the page. */
  constructor(clouds, lines, { draw, repaint = () => this.invalidate(), stage = null }) {
    Object.assign(this, { clouds, lines, draw, repaint, stage });
    Object.assign(this, { canvas: null, renderer: null, waiting: false, checked: false });
  }

  begin(wish) { // e.g. renderer=canvas2d in the page's address
    try {
      if (wish.get("renderer") === "canvas2d") throw new Error("as asked");
      this.start(CardRenderer);
    } catch (problem) {
      this.startPlain(problem.message);
    }
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", this.repaint);
  }

  start(Kind) {
    if (this.canvas) this.canvas.remove();
    const canvas = this.canvas = document.createElement("canvas");
    canvas.setAttribute("aria-hidden", "true");
    if (this.stage) this.stage.prepend(canvas);
    this.renderer = new Kind(canvas, this.clouds, this.lines);
    document.body.dataset.renderer = this.renderer.kind;
    canvas.addEventListener("webglcontextlost", () => {
      if (canvas === this.canvas) this.startPlain("the graphics card was lost");
    });
  }

  startPlain(why) {
    this.start(PlainRenderer);
    say(`Drawn without a graphics card (${why}): slower, otherwise the same.`);
    this.repaint();
  }

  invalidate() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame((time) => {
      this.waiting = false;
      this.draw(time);
    });
  }

  /* Draws what a camera sees. Returns the number of points, or null where nothing came of it and the plain canvas
     has taken over. */
  show(camera, scene) {
    const { renderer } = this, background = styleColor("--stage");
    const ratio = Math.min(renderer.kind === "webgl2" ? 2 : 1, window.devicePixelRatio || 1);
    const { clientWidth, clientHeight } = camera.stage;
    const [width, height] = [clientWidth, clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
    renderer.draw({ ...camera.matrices(width, height), background, ...scene }, width, height, ratio);
    const num = scene.clouds.reduce((sum, { name }) => sum + this.clouds[name].points.length / 3, 0);
    if (this.checked) return num;
    this.checked = true;
    const covered = renderer.covered(background);
    document.body.dataset.covered = covered.toFixed(4);
    if (covered > 0 || num === 0 || renderer.kind !== "webgl2") return num;
    this.checked = false; // a driver that accepts everything and draws nothing
    this.startPlain("it drew nothing");
    return null;
  }
}
