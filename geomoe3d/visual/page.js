"use strict";
/* State and controls of the page of one registration; drawing is page_draw.js, the camera page_view.js. Everything
   shown comes from the JSON block; text that a user can influence only ever enters the document as textContent. */

(() => {
  const byId = (id) => document.getElementById(id);
  const data = JSON.parse(byId("data").textContent);
  const wish = new URLSearchParams(location.hash.slice(1)); // e.g. #at=0&color=distance&side=top&renderer=canvas2d
  const stage = byId("stage");

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
  const lines = unpackLines(data.lines);

  /* ---------- state ---------- */
  const state = {
    progress: data.motions.answer ? 1 : 0, motion: "answer", color: "cloud", size: 0,
    source: true, target: true, classes: data.lines.classes.map((kind) => kind.shown), playing: false,
  };

  /* ---------- rigid motion ---------- */
  // Row-major 4x4 -> [unit quaternion w x y z, translation, scale].
  function parts(m) {
    const rows = [[m[0], m[1], m[2]], [m[4], m[5], m[6]], [m[8], m[9], m[10]]];
    const scale = Math.cbrt(rows.reduce((product, row) => product * Math.hypot(...row), 1));
    const [a, b, c, d, e, f, g, h, i] = rows.flat().map((v) => v / scale);
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
    return [q.map((v) => v / length), t, scale];
  }
  function slerp(p, q, s) {
    let cosine = p.reduce((sum, v, i) => sum + v * q[i], 0);
    if (cosine < 0) { q = q.map((v) => -v); cosine = -cosine; } // the short way round
    const angle = Math.acos(Math.min(1, cosine));
    const [wp, wq] = angle < 1e-6 ? [1 - s, s] : [Math.sin((1 - s) * angle) / Math.sin(angle), Math.sin(s * angle) / Math.sin(angle)];
    const r = p.map((v, i) => wp * v + wq * q[i]), length = Math.hypot(...r);
    return r.map((v) => v / length);
  }
  // Column-major 4x4 of a quaternion, a translation and a scale.
  function compose([w, x, y, z], t, scale) {
    const m = Float64Array.of(
      1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
      2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
      2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0,
      t[0], t[1], t[2], 1);
    for (const k of [0, 1, 2, 4, 5, 6, 8, 9, 10]) m[k] *= scale;
    return m;
  }
  /* The source is centred on itself, so it turns about its own middle while that moves on a straight line:
     a rigid motion at every instant, never a shrinking blend of two matrices. An estimated scale grows along. */
  function sourceModel() {
    const [q0, t0, scale0] = parts(data.motions.before);
    if (!data.motions[state.motion]) return compose(q0, t0, scale0);
    const [q1, t1, scale1] = parts(data.motions[state.motion]);
    const s = state.progress;
    return compose(slerp(q0, q1, s), t0.map((v, i) => (1 - s) * v + s * t1[i]), scale0 ** (1 - s) * scale1 ** s);
  }

  /* ---------- camera and canvas ---------- */
  const display = new Display(clouds, lines, { stage, draw, repaint: paint });
  const invalidate = () => display.invalidate();
  const camera = new Camera(stage, {
    axes: data.axes, radius: data.radius, sides: { home: [-0.6, 0.5], ...SIDES }, changed: invalidate,
  });
  // Until the user moves or zooms, the view follows both clouds on their way from before to after.
  function fit() {
    const from = data.fits.before, to = data.fits[state.motion] || from, s = state.progress;
    const seen = Float64Array.of(...sample(clouds.target.points), ...sample(clouds.source.points, sourceModel()));
    camera.fit(from.center.map((v, i) => (1 - s) * v + s * to.center[i]), (1 - s) * from.radius + s * to.radius, seen);
  }

  /* ---------- colours ---------- */
  const SCALE = [[59, 76, 192], [141, 176, 254], [214, 216, 222], [244, 152, 122], [180, 4, 38]];
  byId("scale").querySelector("i").style.background =
    `linear-gradient(to right, ${SCALE.map((c) => `rgb(${c.join(",")})`).join(",")})`;
  function ramp(value) {
    const at = value / 255 * (SCALE.length - 1), low = Math.min(Math.floor(at), SCALE.length - 2), rest = at - low;
    return SCALE[low].map((v, i) => Math.round(v + rest * (SCALE[low + 1][i] - v)));
  }
  const APART = [128, 132, 140]; // nothing of the target is near
  const RAMP = Array.from({ length: 256 }, (_, i) => i < 255 ? ramp(i * 255 / 254) : APART);
  /* How many points lie how far from the target: one bar for five of the 255 steps. */
  function showHistogram(values) {
    const bars = new Array(51).fill(0), near = values.filter((v) => v < 255);
    for (const v of near) bars[Math.floor(v / 5)] += 1;
    const most = Math.max(1, ...bars);
    byId("histogram").replaceChildren(...bars.map((count) => {
      const bar = document.createElement("i");
      bar.style.height = `${100 * count / most}%`;
      return bar;
    }));
    const apart = values.length - near.length, reach = data.distanceReach.toPrecision(3);
    byId("beyond").textContent = `${near.length} of ${values.length} source points drawn have a target point within ${reach}`
      + (apart ? "; the others are grey" : "");
  }
  function paint() {
    for (const [name, cloud] of Object.entries(clouds)) {
      let plain = styleColor("--" + name);
      if (state.color === "distance" && name === "target") plain = APART;
      const values = name === "source" && state.color === "distance" ? distances[state.motion] : null;
      if (state.color === "file" && cloud.file) cloud.colors = cloud.file.slice();
      else {
        cloud.colors = oneColor(cloud.points.length, plain);
        if (values) for (let i = 0; i < cloud.points.length; i += 3) cloud.colors.set(RAMP[values[i / 3]], i);
      }
      display.renderer.recolor(name, cloud.colors);
    }
    byId("scale").hidden = state.color !== "distance";
    if (state.color === "distance" && distances[state.motion]) showHistogram(distances[state.motion]);
    invalidate();
  }

  /* ---------- drawing ---------- */
  function draw(time) {
    if (state.playing) advance(time);
    if (camera.fitted) fit();
    const model = sourceModel();
    const shown = [["source", model], ["target", STILL]].filter(([name]) => state[name]).map(([name, m]) => ({ name, model: m }));
    const num = display.show(camera, { model, clouds: shown, classes: state.classes, diameter: 2 * data.spacing * 2 ** state.size });
    if (num === null) return;
    // What was drawn, for tests and for whoever scripts the page.
    document.body.dataset.drawnPoints = String(num);
    document.body.dataset.drawnLines = String(state.classes.reduce((sum, on, i) => sum + (on ? lines.ranges[i][1] : 0), 0));
    document.body.dataset.model = Array.from(model, (v) => v.toPrecision(12)).join(" ");
    document.body.dataset.camera = [camera.yaw, camera.pitch, camera.distance, ...camera.center].map((v) => v.toPrecision(6)).join(" ");
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

  /* ---------- controls ---------- */
  listen(camera, { keys: { ...camera.sideKeys(), " ": () => play(!state.playing) } });
  byId("progress").addEventListener("input", (event) => { play(false); state.progress = Number(event.target.value); invalidate(); });
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("controls").addEventListener("submit", (event) => event.preventDefault());
  byId("show-source").addEventListener("change", (event) => { state.source = event.target.checked; invalidate(); });
  byId("show-target").addEventListener("change", (event) => { state.target = event.target.checked; invalidate(); });
  byId("size").addEventListener("input", (event) => { state.size = Number(event.target.value); invalidate(); });
  byId("cut").addEventListener("input", (event) => { camera.cut = Number(event.target.value); invalidate(); });
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
  byId("limit").textContent = `≥ ${data.distanceLimit.toPrecision(3)} ${data.unit}`;
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
  display.begin(wish);
  new ResizeObserver(invalidate).observe(stage);
  camera.goTo(wish.get("side"));
  if (wish.has("at") && data.motions.answer) {
    state.progress = Math.min(1, Math.max(0, Number(wish.get("at")) || 0));
    byId("progress").value = String(state.progress);
  }
  if (wish.has("cut")) {
    camera.cut = Math.min(1, Math.max(0, Number(wish.get("cut")) || 0));
    byId("cut").value = String(camera.cut);
  }
  for (const name of ["motion", "color"]) if (wish.has(name)) choose(name, wish.get(name));
  paint();
})();
