"use strict";
/* The gallery and the legends of the report. All clouds share one renderer of page_draw.js, whose picture is
   copied into the card that asked for it: browsers allow only a few graphics contexts per page. */

function report(problem) {
  document.body.dataset.error = String((problem && problem.message) || problem);
}
window.addEventListener("error", (event) => report(event.error || event.message));

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
  const FIELD = 40 * Math.PI / 180;
  const SIDES = { slanted: [-0.6, 0.5], top: [0, Math.PI / 2], front: [0, 0] };
  const NO_LINES = { vertices: new Float32Array(0), ends: new Float32Array(0), colors: new Uint8Array(0), ranges: [] };
  const STILL = Float64Array.of(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);
  const styleColor = (name) => {
    const text = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16));
  };
  const columns = (m) => Float64Array.from({ length: 16 }, (_, i) => m[4 * (i % 4) + (i >> 2)]);
  function unpack({ points, scale }) {
    const bytes = Uint8Array.from(atob(points), (letter) => letter.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    return Float32Array.from({ length: bytes.length / 2 }, (_, i) => scale * view.getInt16(2 * i, true));
  }

  const clouds = {}, cards = [];
  for (const [id, card] of Object.entries(data)) {
    for (const name of ["source", "target"]) {
      const points = unpack(card[name]);
      clouds[`${name}-${id}`] = { points, colors: new Uint8Array(points.length) };
    }
    const element = document.getElementById(`card-${id}`), stage = element.querySelector(".stage");
    cards.push({ ...card, id, element, stage, canvas: stage.querySelector("canvas"), motion: Object.keys(card.motions)[0],
      yaw: SIDES.slanted[0], pitch: SIDES.slanted[1], center: [0, 0, 0], distance: 1, fitted: true, visible: false, stale: true });
  }

  let renderer = null, waiting = false, checked = false;
  function start(Kind) {
    const canvas = document.createElement("canvas");
    renderer = new Kind(canvas, clouds, NO_LINES);
    document.body.dataset.renderer = renderer.kind;
    canvas.addEventListener("webglcontextlost", () => { if (renderer.kind === "webgl2") { start(PlainRenderer); paint(); } });
  }
  function paint() {
    for (const [name, cloud] of Object.entries(clouds)) {
      const color = styleColor("--" + name.split("-")[0]);
      cloud.colors = new Uint8Array(cloud.points.length);
      for (let i = 0; i < cloud.points.length; i += 3) cloud.colors.set(color, i);
      renderer.recolor(name, cloud.colors);
    }
    cards.forEach(invalidate);
  }
  function invalidate(card) {
    card.stale = true;
    if (!waiting) { waiting = true; requestAnimationFrame(drawAll); }
  }
  function drawAll() {
    waiting = false;
    for (const card of cards) if (card.stale && card.visible) draw(card);
  }

  /* ---------- camera and drawing ---------- */
  function axesOf({ axes: [right, forward, up], yaw, pitch }) {
    const level = forward.map((v, i) => Math.cos(yaw) * v - Math.sin(yaw) * right[i]);
    return {
      across: right.map((v, i) => Math.cos(yaw) * v + Math.sin(yaw) * forward[i]),
      look: level.map((v, i) => Math.cos(pitch) * v - Math.sin(pitch) * up[i]), // into the picture
      above: level.map((v, i) => Math.sin(pitch) * v + Math.cos(pitch) * up[i]),
    };
  }
  function draw(card) {
    card.stale = false;
    const { stage, canvas } = card, fit = card.fits[card.motion];
    const ratio = Math.min(renderer.kind === "webgl2" ? 2 : 1, window.devicePixelRatio || 1);
    const width = Math.max(1, Math.round(stage.clientWidth * ratio)), height = Math.max(1, Math.round(stage.clientHeight * ratio));
    if (card.fitted) {
      card.center = fit.center;
      card.distance = 1.02 * fit.radius / Math.sin(FIELD / 2) / Math.min(1, width / height);
    }
    const { across, above, look } = axesOf(card), dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const eye = card.center.map((v, i) => v - card.distance * look[i]);
    const view = Float64Array.of(
      across[0], above[0], -look[0], 0, across[1], above[1], -look[1], 0, across[2], above[2], -look[2], 0,
      -dot(across, eye), -dot(above, eye), dot(look, eye), 1);
    const near = 0.02 * card.distance, far = card.distance + 20 * fit.radius, focal = 1 / Math.tan(FIELD / 2);
    const projection = new Float64Array(16);
    projection[0] = focal * height / width;
    projection[5] = focal;
    projection[10] = (far + near) / (near - far);
    projection[11] = -1;
    projection[14] = 2 * far * near / (near - far);
    const model = columns(card.motions[card.motion]), background = styleColor("--stage");
    renderer.draw({ model, view, projection, near, far, pixelsPerUnit: focal * height / 2, background, classes: [],
      diameter: 1.6 * card.spacing,
      clouds: [{ name: `source-${card.id}`, model }, { name: `target-${card.id}`, model: STILL }] }, width, height, ratio);
    if (!checked) {
      checked = true;
      const covered = renderer.covered(background);
      document.body.dataset.covered = covered.toFixed(4);
      if (covered === 0 && renderer.kind === "webgl2") { // a driver that accepts everything and draws nothing
        checked = false;
        start(PlainRenderer);
        paint();
        return;
      }
    }
    canvas.width = width;
    canvas.height = height;
    canvas.getContext("2d").drawImage(renderer.canvas, 0, 0);
    // What was drawn, for tests and for whoever scripts the page.
    stage.dataset.drawn = `${card.motion} ${[card.yaw, card.pitch, card.distance].map((v) => v.toPrecision(5)).join(" ")}`;
    document.body.dataset.drawn = String(document.querySelectorAll(".stage[data-drawn]").length);
    document.body.dataset.first = cards[0].stage.dataset.drawn || "";
  }

  /* ---------- pointer, wheel, keys ---------- */
  function turn(card, dx, dy) {
    card.yaw -= dx;
    card.pitch = Math.min(Math.PI / 2, Math.max(-Math.PI / 2, card.pitch + dy));
    invalidate(card);
  }
  function zoom(card, factor) {
    const { radius } = card.fits[card.motion];
    card.fitted = false;
    card.distance = Math.min(20 * radius, Math.max(0.05 * radius, card.distance * factor));
    invalidate(card);
  }
  function move(card, dx, dy) { // in pixels of the stage
    const unit = 2 * card.distance * Math.tan(FIELD / 2) / Math.max(1, card.stage.clientHeight), { across, above } = axesOf(card);
    card.fitted = false;
    card.center = card.center.map((v, i) => v + unit * (-dx * across[i] + dy * above[i]));
    invalidate(card);
  }
  function goTo(card, side) {
    [card.yaw, card.pitch] = SIDES[side];
    card.fitted = true;
    invalidate(card);
  }
  function listen(card) {
    const { stage, element } = card, fingers = new Map();
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
        zoom(card, Math.max(1, span(old)) / Math.max(1, span(now)));
        move(card, dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons & 6) move(card, dx, dy);
      else turn(card, dx * 0.009, dy * 0.009);
      fingers.set(event.pointerId, now);
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      stage.addEventListener(name, (event) => fingers.delete(event.pointerId));
    }
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    stage.addEventListener("wheel", (event) => {
      if (document.activeElement !== stage) return; // the page scrolls until a view is chosen
      event.preventDefault();
      zoom(card, Math.exp(Math.max(-60, Math.min(60, event.deltaMode === 1 ? 18 * event.deltaY : event.deltaY)) * 0.0025));
    }, { passive: false });
    stage.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.altKey || event.metaKey) return;
      const arrow = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (arrow) {
        if (event.shiftKey) move(card, 30 * arrow[0], 30 * arrow[1]);
        else turn(card, 0.09 * arrow[0], 0.09 * arrow[1]);
      } else if (event.key === "+" || event.key === "=") zoom(card, 0.87);
      else if (event.key === "-" || event.key === "_") zoom(card, 1.15);
      else return;
      event.preventDefault();
    });
    element.querySelectorAll('input[type="radio"]').forEach((input) => input.addEventListener("change", () => {
      card.motion = input.value;
      invalidate(card);
    }));
    element.querySelectorAll("button[data-side]").forEach((button) => button.addEventListener("click", () => goTo(card, button.dataset.side)));
  }

  /* ---------- begin ---------- */
  if (cards.length) {
    try {
      if (wish.get("renderer") === "canvas2d") throw new Error("as asked");
      start(CardRenderer);
    } catch {
      start(PlainRenderer);
    }
    paint();
    const near = new IntersectionObserver((entries) => entries.forEach(({ target, isIntersecting }) => {
      const card = cards.find((one) => one.stage === target);
      card.visible = isIntersecting;
      if (isIntersecting && card.stale) invalidate(card);
    }), { rootMargin: "300px" });
    const size = new ResizeObserver((entries) => entries.forEach(({ target }) => invalidate(cards.find((one) => one.stage === target))));
    for (const card of cards) { listen(card); near.observe(card.stage); size.observe(card.stage); }
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
  }
  document.body.dataset.cards = String(cards.length);
  document.body.dataset.ready = "true";
})();
