"use strict";
/* The gallery and the legends of the report. All clouds share one renderer of page_draw.js, whose picture is
   copied into the card that asked for it: browsers allow only a few graphics contexts per page. Each card has a
   camera of page_view.js. */

(() => {
  /* ---------- runs can be switched off in all plots ---------- */
  document.querySelectorAll("button[data-run]").forEach((button) => button.addEventListener("click", () => {
    const off = button.getAttribute("aria-pressed") === "true", run = button.dataset.run;
    document.querySelectorAll(`button[data-run="${run}"]`).forEach((one) => one.setAttribute("aria-pressed", String(!off)));
    document.querySelectorAll(`figure .r${run}`).forEach((one) => one.classList.toggle("off", off));
  }));

  /* ---------- clouds ---------- */
  const data = JSON.parse(document.getElementById("data").textContent);
  const wish = new URLSearchParams(location.hash.slice(1)); // e.g. #renderer=canvas2d
  const columns = (m) => Float64Array.from({ length: 16 }, (_, i) => m[4 * (i % 4) + (i >> 2)]);
  function unpack({ points, scale }) {
    const packed = bytes(points), view = new DataView(packed.buffer);
    return Float32Array.from({ length: packed.length / 2 }, (_, i) => scale * view.getInt16(2 * i, true));
  }

  const clouds = {}, cards = [];
  for (const [id, card] of Object.entries(data)) {
    for (const name of ["source", "target"]) {
      const points = unpack(card[name]);
      clouds[`${name}-${id}`] = { points, colors: new Uint8Array(points.length) };
    }
    const element = document.getElementById(`card-${id}`), stage = element.querySelector(".stage");
    const motion = Object.keys(card.motions)[0];
    const one = { ...card, id, element, stage, canvas: stage.querySelector("canvas"), motion, visible: false, stale: true };
    one.camera = new Camera(stage, {
      axes: card.axes, radius: card.fits[motion].radius, sides: { oblique: [-0.6, 0.5], ...SIDES }, limits: [0.05, 20],
      margin: 1.02, changed: () => invalidate(one),
    });
    cards.push(one);
  }

  /* ---------- drawing ---------- */
  const display = new Display(clouds, unpackLines({ vertices: "", classes: [] }), { draw: drawAll, repaint: paint });
  function paint() {
    for (const [name, cloud] of Object.entries(clouds)) {
      const color = styleColor("--" + name.split("-")[0]);
      cloud.colors = oneColor(cloud.points.length, color);
      display.renderer.recolor(name, cloud.colors);
    }
    cards.forEach(invalidate);
  }
  function invalidate(card) {
    card.stale = true;
    display.invalidate();
  }
  function drawAll() {
    for (const card of cards) if (card.stale && card.visible) draw(card);
  }

  function draw(card) {
    const { camera, canvas, stage } = card, fit = card.fits[card.motion];
    card.stale = false;
    if (camera.fitted) camera.fit(fit.center, fit.radius);
    const model = columns(card.motions[card.motion]);
    const shown = [{ name: `source-${card.id}`, model }, { name: `target-${card.id}`, model: STILL }];
    if (display.show(camera, { model, clouds: shown, classes: [], diameter: 1.6 * card.spacing }) === null) return;
    canvas.width = display.canvas.width;
    canvas.height = display.canvas.height;
    canvas.getContext("2d").drawImage(display.canvas, 0, 0);
    // What was drawn, for tests and for whoever scripts the page.
    stage.dataset.drawn = `${card.motion} ${[camera.yaw, camera.pitch, camera.distance].map((v) => v.toPrecision(5)).join(" ")}`;
    document.body.dataset.drawn = String(document.querySelectorAll(".stage[data-drawn]").length);
    document.body.dataset.first = cards[0].stage.dataset.drawn || "";
  }

  /* ---------- controls ---------- */
  function control(card) {
    const { camera, element, stage } = card;
    // The page scrolls until a view is chosen.
    listen(camera, { element, perPixel: 0.009, wheels: () => document.activeElement === stage });
    element.querySelectorAll('input[type="radio"]').forEach((input) => input.addEventListener("change", () => {
      card.motion = input.value;
      camera.radius = card.fits[card.motion].radius;
      invalidate(card);
    }));
  }

  /* ---------- begin ---------- */
  if (cards.length) {
    display.begin(wish);
    paint();
    const near = new IntersectionObserver((entries) => entries.forEach(({ target, isIntersecting }) => {
      const card = cards.find((one) => one.stage === target);
      card.visible = isIntersecting;
      if (isIntersecting && card.stale) invalidate(card);
    }), { rootMargin: "300px" });
    const size = new ResizeObserver((entries) => entries.forEach(({ target }) => invalidate(cards.find((one) => one.stage === target))));
    for (const card of cards) { control(card); near.observe(card.stage); size.observe(card.stage); }
  }
  document.body.dataset.cards = String(cards.length);
  document.body.dataset.ready = "true";
})();
