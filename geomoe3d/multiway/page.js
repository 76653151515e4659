"use strict";
/* Turns a model of many scans; drawing is page_draw.js, the camera page_view.js. */
(() => {
  const byId = (id) => document.getElementById(id);
  const data = JSON.parse(byId("data").textContent), stage = byId("stage");
  const wish = new URLSearchParams(location.search.slice(1));

  /* ---------- what is drawn ---------- */
  const clouds = {}, lines = unpackLines(data.lines);
  for (const { name, color, points } of data.clouds) {
    clouds[name] = { points: floats(points) };
    clouds[name].colors = oneColor(clouds[name].points.length, parseColor(color));
  }
  const everything = Float64Array.from(Object.values(clouds).flatMap((cloud) => [...sample(cloud.points)]));
  const state = { size: 0, hidden: new Set(), classes: data.lines.classes.map((kind) => kind.shown) };

  /* ---------- camera and canvas ---------- */
  const display = new Display(clouds, lines, { stage, draw });
  const invalidate = () => display.invalidate();
  const camera = new Camera(stage, {
    axes: data.axes, radius: data.radius, sides: { home: [-0.6, 0.6], ...SIDES }, changed: invalidate,
  });
  function draw() {
    if (camera.fitted) camera.fit([0, 0, 0], data.radius, everything);
    const shown = Object.keys(clouds).filter((name) => !state.hidden.has(name)).map((name) => ({ name, model: STILL }));
    const num = display.show(camera, { model: STILL, clouds: shown, classes: state.classes,
      diameter: 0.8 * data.spacing * 2 ** state.size });
    if (num === null) return;
    document.body.dataset.drawnPoints = String(num);
    document.body.dataset.drawnLines = String(state.classes.reduce((sum, on, i) => sum + (on ? lines.ranges[i][1] : 0), 0));
    document.body.dataset.ready = "true";
  }

  /* ---------- controls ---------- */
  listen(camera, { keys: camera.sideKeys() });
  byId("size").addEventListener("input", (event) => { state.size = Number(event.target.value); invalidate(); });
  byId("cut").addEventListener("input", (event) => { camera.cut = Number(event.target.value); invalidate(); });
  const boxes = [...document.querySelectorAll("[data-scan]")];
  function show(box, on) {
    box.checked = on;
    if (on) state.hidden.delete(box.dataset.scan);
    else state.hidden.add(box.dataset.scan);
    invalidate();
  }
  boxes.forEach((box) => box.addEventListener("change", () => show(box, box.checked)));
  document.querySelectorAll("button.pair").forEach((button) => button.addEventListener("click", () => {
    const { source, target } = button.dataset;
    boxes.forEach((box) => show(box, box.dataset.scan === source || box.dataset.scan === target));
  }));
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
  display.begin(wish);
  new ResizeObserver(invalidate).observe(stage);
  camera.goTo(wish.get("side"));
})();
