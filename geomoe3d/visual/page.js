"use strict";
/* State, camera and controls of the page. Everything shown comes from the JSON block; text that a user can
   influence only ever enters the document as textContent. */

function report(problem) {
  document.body.dataset.error = String((problem && problem.message) || problem);
  const notice = document.getElementById("notice");
  notice.textContent = "The 3D view failed: " + document.body.dataset.error;
  notice.hidden = false;
}
window.addEventListener("error", (event) => report(event.error || event.message));
window.addEventListener("unhandledrejection", (event) => report(event.reason));

(() => {
  const byId = (id) => document.getElementById(id);
  const data = JSON.parse(byId("data").textContent);
  const wish = new URLSearchParams(location.hash.slice(1)); // e.g. #at=0&color=distance&side=top&renderer=canvas2d
  const stage = byId("stage");

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const floats = (text) => new Float32Array(bytes(text).buffer);
  const parseColor = (text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));
  const styleColor = (name) => parseColor(getComputedStyle(document.documentElement).getPropertyValue(name).trim());

  /* ---------- data ---------- */
  const clouds = {};
  for (const name of ["source", "target"]) {
    const points = floats(data[name].points);
    clouds[name] = {
      points,
      colors: new Uint8Array(points.length),
      file: data[name].colors ? bytes(data[name].colors) : null,
    };
  }
  const distances = {};
  for (const [name, text] of Object.entries(data.distances)) distances[name] = text ? bytes(text) : null;
  const lines = { vertices: floats(data.lines.vertices), ends: null, colors: null, ranges: [] };
  const numLines = lines.vertices.length / 6;
  lines.ends = Float32Array.from({ length: 2 * numLines }, (_, i) => i % 2);
  lines.colors = new Uint8Array(6 * numLines);
  let first = 0;
  for (const kind of data.lines.classes) {
    lines.ranges.push([first, kind.drawn]);
    const color = parseColor(kind.color);
    for (let i = 6 * first; i < 6 * (first + kind.drawn); i++) lines.colors[i] = color[i % 3];
    first += kind.drawn;
  }

  /* ---------- state ---------- */
  const state = {
    progress: data.motions.answer ? 1 : 0, motion: "answer", color: "cloud", size: 0, cut: 0,
    source: true, target: true, classes: data.lines.classes.map((kind) => kind.shown),
    yaw: -0.6, pitch: 0.5, distance: 1, center: [0, 0, 0], fitted: true, playing: false,
  };
  const FIELD = 40 * Math.PI / 180;
  const SIDES = { home: [-0.6, 0.5], top: [0, Math.PI / 2], front: [0, 0], side: [Math.PI / 2, 0] };
  const [right, forward, up] = data.axes;

  /* ---------- rigid motion ---------- */
  // Row-major 4x4 -> [unit quaternion w x y z, translation].
  function parts(m) {
    const [a, b, c, , d, e, f, , g, h, i] = m;
    const t = [m[3], m[7], m[11]];
    const squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i];
    const largest = squares.indexOf(Math.max(...squares)); // the best conditioned of the four formulas
    const s = 2 * Math.sqrt(squares[largest]);
    const q = [
      [s / 4, (h - f) / s, (c - g) / s, (d - b) / s],
      [(h - f) / s, s / 4, (b + d) / s, (c + g) / s],
      [(c - g) / s, (b + d) / s, s / 4, (f + h) / s],
      [(d - b) / s, (c + g) / s, (f + h) / s, s / 4],
    ][largest];
    const length = Math.hypot(...q);
    return [q.map((v) => v / length), t];
  }
  function slerp(p, q, s) {
    let cosine = p.reduce((sum, v, i) => sum + v * q[i], 0);
    if (cosine < 0) { q = q.map((v) => -v); cosine = -cosine; } // the short way round
    const angle = Math.acos(Math.min(1, cosine));
    const [wp, wq] = angle < 1e-6 ? [1 - s, s] : [Math.sin((1 - s) * angle) / Math.sin(angle), Math.sin(s * angle) / Math.sin(angle)];
    const r = p.map((v, i) => wp * v + wq * q[i]), length = Math.hypot(...r);
    return r.map((v) => v / length);
  }
  // Column-major 4x4 of a quaternion and a translation.
  function compose([w, x, y, z], t) {
    return Float64Array.of(
      1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
      2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
      2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0,
      t[0], t[1], t[2], 1);
  }
  /* The source is centred on itself, so it turns about its own middle while that moves on a straight line:
     a rigid motion at every instant, never a shrinking blend of two matrices. */
  function sourceModel() {
    const [q0, t0] = parts(data.motions.before);
    if (!data.motions[state.motion]) return compose(q0, t0);
    const [q1, t1] = parts(data.motions[state.motion]);
    const s = state.progress;
    return compose(slerp(q0, q1, s), t0.map((v, i) => (1 - s) * v + s * t1[i]));
  }

  /* ---------- camera ---------- */
  function axesOfCamera() {
    const [cy, sy, cp, sp] = [Math.cos(state.yaw), Math.sin(state.yaw), Math.cos(state.pitch), Math.sin(state.pitch)];
    const across = right.map((v, i) => cy * v + sy * forward[i]);
    const level = forward.map((v, i) => cy * v - sy * right[i]);
    const look = level.map((v, i) => cp * v - sp * up[i]); // into the picture
    const above = level.map((v, i) => sp * v + cp * up[i]);
    return [across, above, look];
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
    const focal = 1 / Math.tan(FIELD / 2);
    const projection = new Float64Array(16);
    projection[0] = focal * height / width;
    projection[5] = focal;
    projection[10] = (far + near) / (near - far);
    projection[11] = -1;
    projection[14] = 2 * far * near / (near - far);
    return { view, projection, near, far, pixelsPerUnit: focal * height / 2 };
  }
  function goTo(side) {
    [state.yaw, state.pitch] = SIDES[side];
    state.fitted = true;
    invalidate();
  }
  // Until the user moves or zooms, the view follows both clouds on their way from before to after.
  function fit() {
    const from = data.fits.before, to = data.fits[state.motion] || from, s = state.progress;
    const narrow = Math.min(1, stage.clientWidth / Math.max(1, stage.clientHeight));
    state.center = from.center.map((v, i) => (1 - s) * v + s * to.center[i]);
    state.distance = 1.05 * ((1 - s) * from.radius + s * to.radius) / Math.sin(FIELD / 2) / narrow;
  }
  function turn(dx, dy) {
    state.yaw -= dx;
    state.pitch = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, state.pitch + dy));
    invalidate();
  }
  function move(dx, dy) { // in pixels of the stage
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

  /* ---------- colours ---------- */
  const SCALE = [[59, 76, 192], [141, 176, 254], [214, 216, 222], [244, 152, 122], [180, 4, 38]];
  byId("scale").querySelector("i").style.background =
    `linear-gradient(to right, ${SCALE.map((c) => `rgb(${c.join(",")})`).join(",")})`;
  function ramp(value) {
    const at = value / 255 * (SCALE.length - 1), low = Math.min(Math.floor(at), SCALE.length - 2), rest = at - low;
    return SCALE[low].map((v, i) => Math.round(v + rest * (SCALE[low + 1][i] - v)));
  }
  const RAMP = Array.from({ length: 256 }, (_, i) => ramp(i));
  function paint() {
    for (const [name, cloud] of Object.entries(clouds)) {
      let plain = styleColor("--" + name);
      if (state.color === "distance" && name === "target") plain = [128, 132, 140];
      const values = name === "source" && state.color === "distance" ? distances[state.motion] : null;
      if (state.color === "file" && cloud.file) cloud.colors = cloud.file.slice();
      else {
        cloud.colors = new Uint8Array(cloud.points.length);
        for (let i = 0; i < cloud.points.length; i += 3) cloud.colors.set(values ? RAMP[values[i / 3]] : plain, i);
      }
      renderer.recolor(name, cloud.colors);
    }
    byId("scale").hidden = state.color !== "distance";
    invalidate();
  }

  /* ---------- drawing ---------- */
  let renderer = null, canvas = null, waiting = false, checked = false;
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
    const notice = byId("notice");
    notice.textContent = `Drawn without a graphics card (${why}): slower, otherwise the same.`;
    notice.hidden = false;
    paint();
  }
  function invalidate() {
    if (!waiting) { waiting = true; requestAnimationFrame(draw); }
  }
  function draw(time) {
    waiting = false;
    if (state.playing) advance(time);
    if (state.fitted) fit();
    const ratio = Math.min(renderer.kind === "webgl2" ? 2 : 1, window.devicePixelRatio || 1);
    const width = Math.max(1, Math.round(stage.clientWidth * ratio)), height = Math.max(1, Math.round(stage.clientHeight * ratio));
    const model = sourceModel(), camera = cameraMatrices(width, height);
    const still = Float64Array.of(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);
    const shown = [["source", model], ["target", still]].filter(([name]) => state[name]).map(([name, m]) => ({ name, model: m }));
    const background = styleColor("--stage");
    renderer.draw({ ...camera, model, clouds: shown, classes: state.classes, background,
      diameter: 2 * data.spacing * 2 ** state.size }, width, height, ratio);
    const num = shown.reduce((sum, { name }) => sum + clouds[name].points.length / 3, 0);
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
    // What was drawn, for tests and for whoever scripts the page.
    document.body.dataset.drawnPoints = String(num);
    document.body.dataset.drawnLines = String(state.classes.reduce((sum, on, i) => sum + (on ? lines.ranges[i][1] : 0), 0));
    document.body.dataset.model = Array.from(model, (v) => v.toPrecision(12)).join(" ");
    document.body.dataset.camera = [state.yaw, state.pitch, state.distance, ...state.center].map((v) => v.toPrecision(6)).join(" ");
    document.body.dataset.ready = "true";
  }

  let direction = 1, before = null;
  function advance(time) {
    const step = before === null ? 0 : Math.min(0.1, (time - before) / 1000) / 1.8;
    before = time;
    state.progress += direction * step;
    if (state.progress >= 1 || state.progress <= 0) {
      state.progress = Math.min(1, Math.max(0, state.progress));
      direction = -direction;
    }
    byId("progress").value = String(state.progress);
    invalidate();
  }
  function play(on) {
    state.playing = on && Boolean(data.motions.answer);
    before = null;
    direction = state.progress >= 1 ? -1 : 1;
    byId("play").textContent = state.playing ? "Stop" : "Play";
    byId("play").setAttribute("aria-pressed", String(state.playing));
    invalidate();
  }

  /* ---------- pointer, wheel, keys ---------- */
  const fingers = new Map();
  stage.addEventListener("pointerdown", (event) => {
    if (event.target !== stage && event.target !== canvas) return;
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
    else if (event.key === " ") play(!state.playing);
    else return;
    event.preventDefault();
  });

  /* ---------- controls ---------- */
  byId("progress").addEventListener("input", (event) => { play(false); state.progress = Number(event.target.value); invalidate(); });
  byId("play").addEventListener("click", () => play(!state.playing));
  document.querySelectorAll("[data-side]").forEach((button) => button.addEventListener("click", () => goTo(button.dataset.side)));
  byId("controls").addEventListener("submit", (event) => event.preventDefault());
  byId("show-source").addEventListener("change", (event) => { state.source = event.target.checked; invalidate(); });
  byId("show-target").addEventListener("change", (event) => { state.target = event.target.checked; invalidate(); });
  byId("size").addEventListener("input", (event) => { state.size = Number(event.target.value); invalidate(); });
  byId("cut").addEventListener("input", (event) => { state.cut = Number(event.target.value); invalidate(); });
  function choose(name, value) {
    const input = document.querySelector(`input[name="${name}"][value="${CSS.escape(value)}"]`);
    if (!input || input.closest("[hidden]")) return;
    input.checked = true;
    state[name] = value;
    paint();
  }
  document.querySelectorAll('input[name="motion"], input[name="color"]').forEach((input) =>
    input.addEventListener("change", () => choose(input.name, input.value)));
  byId("motions").hidden = !data.motions.alternative;
  byId("color-file").hidden = !(clouds.source.file || clouds.target.file);
  byId("color-distance").hidden = !distances.answer;
  byId("limit").textContent = "≥ " + data.distanceLimit.toPrecision(3);
  if (!data.motions.answer) for (const id of ["progress", "play"]) byId(id).disabled = true;
  byId("progress").value = String(state.progress);

  const legend = byId("legend");
  function entry(text, color, className) {
    const item = document.createElement("li"), mark = document.createElement("i");
    mark.style.background = color;
    if (className) mark.className = className;
    item.append(mark, text);
    legend.append(item);
  }
  entry("source", "var(--source)");
  entry("target", "var(--target)");
  data.lines.classes.forEach((kind, i) => {
    entry(kind.label, kind.color, "stroke");
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox";
    box.checked = state.classes[i];
    box.addEventListener("change", () => { state.classes[i] = box.checked; invalidate(); });
    const count = kind.drawn === kind.total ? `${kind.total}` : `${kind.drawn} of ${kind.total}`;
    label.append(box, ` ${kind.label} (${count})`);
    byId("classes").append(label);
  });

  document.querySelectorAll("button[data-copy]").forEach((button) => button.addEventListener("click", async () => {
    const text = data.matrices[button.dataset.copy], said = button.nextElementSibling;
    try {
      await navigator.clipboard.writeText(text);
      said.textContent = "copied";
    } catch {
      const area = document.createElement("textarea"); // pages opened from a file may lack the clipboard
      area.value = text;
      document.body.append(area);
      area.select();
      said.textContent = document.execCommand("copy") ? "copied" : "the browser refuses; select the numbers";
      area.remove();
    }
    setTimeout(() => { said.textContent = ""; }, 2500);
  }));

  /* ---------- begin ---------- */
  try {
    if (wish.get("renderer") === "canvas2d") throw new Error("as asked");
    start(CardRenderer);
  } catch (problem) {
    startPlain(problem.message);
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
  new ResizeObserver(invalidate).observe(stage);
  goTo(SIDES[wish.get("side")] ? wish.get("side") : "home");
  if (wish.has("at") && data.motions.answer) {
    state.progress = Math.min(1, Math.max(0, Number(wish.get("at")) || 0));
    byId("progress").value = String(state.progress);
  }
  if (wish.has("cut")) {
    state.cut = Math.min(1, Math.max(0, Number(wish.get("cut")) || 0));
    byId("cut").value = String(state.cut);
  }
  for (const name of ["motion", "color"]) if (wish.has(name)) choose(name, wish.get(name));
  paint();
})();
