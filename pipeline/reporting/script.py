"""The report page's behaviour: sliders, sorting, the cloud that can be turned. Without it the
page still shows everything but the cloud."""

JS = """
"use strict";
for (const input of document.querySelectorAll("[data-toggle]"))
  input.addEventListener("change", () =>
    document.getElementById(input.dataset.target)
      .classList.toggle(input.dataset.toggle, input.value === "on"));

for (const input of document.querySelectorAll(".triple input"))
  input.addEventListener("input", () =>
    input.parentElement.style.setProperty("--at", input.value + "%"));

for (const button of document.querySelectorAll("th button"))
  button.addEventListener("click", () => {
    const head = button.parentElement, table = head.closest("table");
    const column = [...head.parentElement.children].indexOf(head);
    const down = head.getAttribute("aria-sort") === "ascending";
    for (const other of head.parentElement.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const key = row => row.children[column].dataset.value;
    const rows = [...table.tBodies[0].rows];
    rows.sort((a, b) => {
      const x = key(a), y = key(b);
      if (x === "" || y === "") return (x === "") - (y === "");  // missing values last
      const order = isNaN(x) || isNaN(y) ? x.localeCompare(y, "en", {numeric: true}) : x - y;
      return down ? -order : order;
    });
    table.tBodies[0].append(...rows);
  });

const space = document.getElementById("space");
if (space) drawSpace(space, JSON.parse(document.getElementById("cloud").textContent));

function drawSpace(space, cloud) {
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const packed = new DataView(bytes(cloud.points).buffer), colours = bytes(cloud.colours);
  const count = packed.byteLength / 6, xyz = new Float32Array(3 * count);
  for (let i = 0; i < xyz.length; i++) xyz[i] = packed.getInt16(2 * i, true) / cloud.steps;
  const canvas = space.querySelector("canvas"), label = space.querySelector("output");
  const context = canvas.getContext("2d");
  const start = {yaw: cloud.yaw - 0.5, pitch: 0.45, zoom: 1, x: 0, y: 0};
  let view = {...start}, spots = [], due = false;

  function draw() {
    due = false;
    const dense = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.round(space.clientWidth * dense);
    const height = Math.round(space.clientHeight * dense);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width; canvas.height = height;
    }
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw);
    const cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    // Rows: right, down, forward of the eye, which looks along the yaw and downwards by the pitch.
    const m = [sy, -cy, 0, -cy * sp, -sy * sp, -cp, cy * cp, sy * cp, -sp];
    const away = 4.2 / view.zoom, focal = 1.5 * Math.min(width, height * 1.35);
    const left = width / 2 + view.x * dense, top = height / 2 + view.y * dense;
    const project = (x, y, z) => {
      const depth = m[6] * x + m[7] * y + m[8] * z + away;
      return [left + focal * (m[0] * x + m[1] * y + m[2] * z) / depth,
              top + focal * (m[3] * x + m[4] * y + m[5] * z) / depth, depth];
    };
    const image = context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    const nearest = new Float32Array(width * height).fill(Infinity);
    for (let i = 0; i < count; i++) {
      const [u, v, depth] = project(xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]);
      if (depth < 0.05) continue;
      const size = Math.max(1, Math.min(7, Math.round(8 * dense / depth)));
      const x0 = Math.round(u - size / 2), y0 = Math.round(v - size / 2);
      const [r, g, b] = colours.subarray(3 * i, 3 * i + 3);
      const colour = 0xff000000 | b << 16 | g << 8 | r;
      for (let y = Math.max(y0, 0); y < Math.min(y0 + size, height); y++)
        for (let x = Math.max(x0, 0); x < Math.min(x0 + size, width); x++)
          if (depth < nearest[y * width + x]) {
            nearest[y * width + x] = depth; pixels[y * width + x] = colour;
          }
    }
    context.putImageData(image, 0, 0);
    const style = getComputedStyle(space);
    const train = style.getPropertyValue("--train"), test = style.getPropertyValue("--test");
    context.lineWidth = 1.4 * dense; context.lineJoin = "round";
    spots = [];
    cloud.cameras.forEach((c, i) => {
      const s = cloud.size, at = project(c[0], c[1], c[2]);
      const corner = (a, b) => project(
        c[0] + s * (a * c[3] + b * c[6] + 1.3 * c[9]),
        c[1] + s * (a * c[4] + b * c[7] + 1.3 * c[10]),
        c[2] + s * (a * c[5] + b * c[8] + 1.3 * c[11]));
      const corners = [corner(-1, -.75), corner(1, -.75), corner(1, .75), corner(-1, .75)];
      if (at[2] < 0.05 || corners.some(p => p[2] < 0.05)) return;
      context.strokeStyle = context.fillStyle = cloud.test[i] ? test : train;
      context.beginPath();
      corners.forEach((p, j) => j ? context.lineTo(p[0], p[1]) : context.moveTo(p[0], p[1]));
      context.closePath();
      context.globalAlpha = 0.2; context.fill(); context.globalAlpha = 1;
      for (const p of corners) { context.moveTo(at[0], at[1]); context.lineTo(p[0], p[1]); }
      context.stroke();
      spots.push([at[0] / dense, at[1] / dense, cloud.names[i]]);
    });
  }
  const ask = () => { if (!due) { due = true; requestAnimationFrame(draw); } };
  const turn = (x, y) => {
    view.yaw -= x; view.pitch = Math.max(-1.57, Math.min(1.57, view.pitch + y)); ask();
  };
  const zoom = factor => { view.zoom = Math.max(0.3, Math.min(20, view.zoom * factor)); ask(); };

  let held = new Map(), apart = 0;
  const spread = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", event => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, {x: event.clientX, y: event.clientY});
    if (held.size === 2) apart = spread();
  });
  const release = event => held.delete(event.pointerId);
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointermove", event => {
    const last = held.get(event.pointerId);
    if (!last) { point(event); return; }
    const x = event.clientX - last.x, y = event.clientY - last.y;
    last.x = event.clientX; last.y = event.clientY;
    label.textContent = "";
    if (held.size === 2) { const now = spread(); zoom(now / apart); apart = now; }
    else if (event.shiftKey || event.buttons & 6) { view.x += x; view.y += y; ask(); }
    else turn(x * 0.008, y * 0.008);
  });
  canvas.addEventListener("contextmenu", event => event.preventDefault());
  canvas.addEventListener("dblclick", () => { view = {...start}; ask(); });
  // The wheel scrolls the page until the cloud has been clicked.
  canvas.addEventListener("wheel", event => {
    if (document.activeElement !== canvas) return;
    event.preventDefault(); zoom(Math.exp(-event.deltaY * 0.0012));
  }, {passive: false});
  canvas.addEventListener("keydown", event => {
    const act = {
      ArrowLeft: () => turn(-0.08, 0), ArrowRight: () => turn(0.08, 0),
      ArrowUp: () => turn(0, -0.08), ArrowDown: () => turn(0, 0.08),
      "+": () => zoom(1.15), "-": () => zoom(1 / 1.15), Escape: () => canvas.blur(),
    }[event.key];
    if (act) { event.preventDefault(); act(); }
  });
  function point(event) {
    const box = canvas.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    let best = null, reach = 14;
    for (const spot of spots) {
      const distance = Math.hypot(spot[0] - x, spot[1] - y);
      if (distance < reach) { reach = distance; best = spot; }
    }
    label.textContent = best ? best[2] : "";
    if (best) { label.style.left = best[0] + "px"; label.style.top = best[1] + "px"; }
  }
  canvas.addEventListener("pointerleave", () => { label.textContent = ""; });
  new ResizeObserver(ask).observe(space);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", ask);
  ask();
}
"""
