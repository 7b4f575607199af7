/*!
The viewer of splatmake's pages. This script holds, beside splatmake's own code (Apache-2.0):
  Spark 2.2.0, Copyright (c) 2025 World Labs Technologies, Inc. (sparkjs.dev)
  three.js 0.187.0, Copyright (c) 2010-2026 three.js authors (threejs.org)
  fflate 0.8.3, Copyright (c) 2026 Arjun Barrett
each under the MIT License:

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and
associated documentation files (the "Software"), to deal in the Software without restriction,
including without limitation the rights to use, copy, modify, merge, publish, distribute,
sublicense, and/or sell copies of the Software, and to permit persons to whom the Software is
furnished to do so, subject to the following conditions: The above copyright notice and this
permission notice shall be included in all copies or substantial portions of the Software. THE
SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT
LIMITED TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT.
IN NO EVENT SHALL THE AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER
LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN
CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
*/
// Interactive view of the trained scene. ../../space.py writes the page's elements and data for it;
// ../README.md describes how viewer.min.js is built from these files. There are two coordinate
// frames: the world, and the page's frame, in which y is up and the scene is in the unit box around
// the origin. data.frame transforms world coordinates to the page's frame.

import * as THREE from "three";
import { Comparison, place } from "./compare.js";
import { Crop } from "./crop.js";
import { Frusta } from "./frusta.js";
import { Gestures } from "./gestures.js";
import { Coverage } from "./limits.js";
import { Measure } from "./measure.js";
import { Orbit } from "./orbit.js";
import { bytes, poseInPage, Stage } from "./stage.js";

const OVERVIEW = { width: 100, height: 100, fx: 107, fy: 107, cx: 50, cy: 50 }; // 50 degrees
const LARGER = 1.4; // an image of another shape than the canvas is enlarged by this at most
const FADE_OUT = [0.05, 0.4]; // distances from the hull at which far content starts and ends fading
const FOCUS_SHARE = 0.7; // of the distance, after a double click
const PIVOT_REACH = 2; // one orbits points within this multiple of the scene's reach
const HINT_MS = 1800;

const box = document.getElementById("space");
const panel = box.querySelector(".crop");
const tools = document.getElementById("space-tools");
const message = box.querySelector(".message");

try {
  window.viewer = start(JSON.parse(document.getElementById("space-data").textContent));
  window.viewer.ready.catch(fail);
} catch (error) {
  fail(error);
}

function fail(error) {
  const supported = document.createElement("canvas").getContext("webgl2");
  message.textContent = "The scene cannot be shown: " + (supported
    ? error.message ?? error
    : "this browser has no WebGL2, or WebGL2 is disabled.");
}

function parsed() {
  if (document.readyState !== "loading") return;
  return new Promise(done => document.addEventListener("DOMContentLoaded", done, { once: true }));
}

function start(data) {
  const canvas = box.querySelector("canvas");
  const [poster, label, name, hint] = [".poster", ".label", ".name", ".activate"].map(
    selector => box.querySelector(selector));
  const button = Object.fromEntries(
    [...box.querySelectorAll("button")].map(element => [element.name, element]));
  const frame = new THREE.Matrix4().fromArray(data.frame);
  const cameras = data.cameras.map(
    camera => ({ ...camera, ...poseInPage(camera.world_to_camera, frame) }));
  const coverage = new Coverage(cameras, { ...data.depths, codes: bytes(data.depths.codes) });
  const stage = new Stage(canvas, data, frame, coverage);
  const frusta = new Frusta(cameras, data.size, getComputedStyle(box));
  const comparison = new Comparison(box);
  frusta.visible = tools.elements.cameras.checked;
  const measure = new Measure(
    box.querySelector(".measured"), data.unit.scale / frame.getMaxScaleOnAxis(), data.unit.name);
  const crop = new Crop(panel, data.crop, data.unit.scale, frame, (...corners) => stage.crop(...corners));
  stage.scene.add(frusta, measure, crop);
  let lens = OVERVIEW; // the pinhole whose image fills the canvas
  let current = null; // the index of the camera that was shown last, or null for the overview

  const orbit = new Orbit(stage.camera, coverage, () => {
    comparison.show(null);
    const outside = coverage.outside(stage.camera.position);
    stage.setFade(THREE.MathUtils.smoothstep(outside, ...FADE_OUT));
    cut();
    stage.move();
  });

  // From outside, what is in front of the cameras does not hide the scene.
  function cut() {
    const distance = stage.camera.position.distanceTo(coverage.centre);
    const outside = current === null && orbit.limits ? distance - 1.05 * coverage.cameraReach : 0;
    stage.camera.near = Math.max(outside, stage.near);
    stage.camera.updateProjectionMatrix();
  }

  // The focal length in pixels of the page: between that at which the whole image is visible and
  // that at which it covers the canvas.
  function focal() {
    const { clientWidth, clientHeight } = box, { width, height, fx, fy } = lens;
    const fits = [clientWidth * fx / width, clientHeight * fy / height];
    const whole = Math.min(...fits);
    return Math.min(Math.sqrt(whole * Math.max(...fits)), LARGER * whole);
  }

  function resize() {
    const { clientWidth, clientHeight } = box;
    if (stage.busy || !clientWidth || !clientHeight) return;
    const half = Math.atan(clientHeight / (2 * focal()));
    stage.resize(clientWidth, clientHeight, THREE.MathUtils.radToDeg(2 * half));
    if (comparison.camera) comparison.show(comparison.camera, focal(), clientWidth, clientHeight);
    if (poster && data.start !== null)
      place(poster, cameras[data.start], focal(), clientWidth, clientHeight);
  }

  function arrived() {
    frusta.draw(stage.camera.position);
    if (current !== null) comparison.show(lens, focal(), box.clientWidth, box.clientHeight);
    stage.redraw();
  }

  function showCamera(index, animate) {
    const camera = cameras[index], { position, quaternion } = camera;
    const axis = (x, y, z) => new THREE.Vector3(x, y, z).applyQuaternion(quaternion);
    const right = axis(1, 0, 0), forward = axis(0, 0, -1);
    // An up axis that does not change the view: the page's, where it is near the camera's.
    const up = new THREE.Vector3(0, 1, 0).addScaledVector(right, -right.y);
    if (up.length() < 0.3 || Math.abs(up.normalize().dot(forward)) > 0.97) up.copy(axis(0, 1, 0));
    const depth = coverage.pivotDepth(index) ?? Math.max(-position.dot(forward), 0.3);
    const pivot = forward.multiplyScalar(depth).add(position);
    current = index;
    lens = camera;
    name.textContent = camera.name;
    tools.elements.view.value = index;
    resize();
    orbit.show({ position, pivot, up, limits: coverage.around(pivot, { own: index }), arrived }, animate);
  }

  function showOverview() {
    const limits = cameras.length ? coverage.overview() : null;
    const mean = new THREE.Vector3(0, 0, 1e-3);
    for (const { position } of cameras) mean.add(position.clone().sub(coverage.centre).normalize());
    const up = new THREE.Vector3(0, 1, 0);
    const yaw = Math.atan2(mean.x, mean.z) + 0.4;
    const offset = new THREE.Vector3(Math.sin(yaw), 0.6, Math.cos(yaw));
    offset.setLength(2.4 * coverage.reach);
    current = null;
    lens = OVERVIEW;
    name.textContent = "overview";
    tools.elements.view.value = "";
    tools.elements.cameras.checked = frusta.visible = true;
    resize();
    const position = (limits ? limits.clamp(offset, up) : offset).add(coverage.centre);
    orbit.show({ position, pivot: coverage.centre.clone(), up, limits, arrived }, false);
  }

  function look(value, animate = false) {
    if (value === "") showOverview();
    else showCamera(Number(value), animate);
  }

  const reset = () => look(data.start === null ? "" : data.start);

  function step(by) {
    if (!cameras.length) return;
    const from = current ?? (by > 0 ? -1 : 0);
    showCamera((from + by + cameras.length) % cameras.length, true);
  }

  function ended() {
    if (orbit.panned) orbit.recentre(stage.surface(0, 0, 0.15, PIVOT_REACH * coverage.reach));
    frusta.draw(stage.camera.position);
    stage.redraw();
  }

  const device = (x, y) => [2 * x / canvas.clientWidth - 1, 1 - 2 * y / canvas.clientHeight];

  function setMeasuring(active) {
    measure.activate(active);
    button.measure.setAttribute("aria-pressed", active);
    box.classList.toggle("measuring", active);
    stage.redraw();
    if (active) gestures.activate(true);
  }

  function measureAt(x, y) {
    measure.choose(stage.surface(...device(x, y), 2 / canvas.clientHeight));
    stage.redraw();
  }

  const gestures = new Gestures(box, canvas, {
    rotate: (x, y) => orbit.rotate(x, y),
    zoom: factor => orbit.zoom(factor),
    pan: (x, y) => orbit.pan(x, y),
    step, reset, ended,
    enter() {
      if (measure.active) measureAt(canvas.clientWidth / 2, canvas.clientHeight / 2);
    },
    click(x, y) {
      if (measure.active) return measureAt(x, y);
      const found = frusta.at(x, y, stage.camera, canvas);
      if (found) showCamera(found.index, true);
    },
    focus(x, y) {
      if (measure.active) return measureAt(x, y);
      const point = stage.surface(...device(x, y), 0.01, PIVOT_REACH * coverage.reach);
      if (point) orbit.focus(point, FOCUS_SHARE, true);
    },
    changed(active) {
      box.classList.toggle("active", active);
      button.release.hidden = !active;
      hint.classList.remove("shown");
    },
    ignored() {
      hint.classList.add("shown");
      clearTimeout(hint.timer);
      hint.timer = setTimeout(() => hint.classList.remove("shown"), HINT_MS);
    },
  });

  canvas.addEventListener("pointermove", event => {
    const { left, top } = canvas.getBoundingClientRect();
    const found = event.buttons || event.pointerType === "touch" || measure.active ? null
      : frusta.at(event.clientX - left, event.clientY - top, stage.camera, canvas);
    label.textContent = found ? cameras[found.index].name : "";
    canvas.style.cursor = found ? "pointer" : "";
    if (found) Object.assign(label.style, { left: `${found.left}px`, top: `${found.top}px` });
  });
  canvas.addEventListener("pointerleave", () => { label.textContent = ""; });
  button.previous.addEventListener("click", () => step(-1));
  button.next.addEventListener("click", () => step(1));
  button.reset.addEventListener("click", reset);
  button.release.addEventListener("click", () => {
    gestures.activate(false);
    canvas.blur();
  });
  button.measure.addEventListener("click", () => {
    setMeasuring(!measure.active);
    if (measure.active) canvas.focus({ preventScroll: true });
  });
  button.crop.addEventListener("click", () => {
    crop.activate(!crop.visible);
    button.crop.setAttribute("aria-pressed", crop.visible);
  });
  box.addEventListener("keydown", event => {
    if (event.key === "Escape") setMeasuring(false);
  });
  button.full.hidden = !box.requestFullscreen;
  button.full.addEventListener("click", () =>
    document.fullscreenElement ? document.exitFullscreen() : box.requestFullscreen());
  tools.addEventListener("submit", event => event.preventDefault());
  tools.addEventListener("change", () => {
    const { show, cameras } = tools.elements;
    frusta.visible = cameras.checked;
    stage.points.visible = show.value === "points";
    stage.splats.visible = !stage.points.visible;
    ended();
  });
  tools.elements.view.addEventListener("change", event => look(event.target.value));
  new ResizeObserver(resize).observe(box);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", ended);

  async function show() {
    await stage.splats.initialized;
    await stage.settled();
    await stage.shown();
  }

  reset();
  const first = show().then(() => {
    performance.mark("first picture");
    message.hidden = true;
    box.classList.add("shown");
    if (!poster) return;
    poster.remove();
    // The poster stands for the canvas in print.
    matchMedia("print").addEventListener(
      "change", print => print.matches ? box.prepend(poster) : poster.remove());
  });

  // The page's own Gaussians, where `first` shows merged ones. These do for a look, not to measure.
  async function refine() {
    await first;
    await parsed();
    const fine = document.getElementById("splats-fine");
    if (fine) {
      await stage.replace(bytes(fine.textContent));
      await show();
    }
    performance.mark("the page's Gaussians");
    tools.firstElementChild.disabled = false;
    box.classList.add("ready");
  }

  // All Gaussians, where the page has only some and the file beside it can be had. Browsers read no
  // files beside a page that is a file itself.
  async function complete() {
    await ready;
    const say = text => { document.getElementById("space-full").textContent = text; };
    if (location.protocol === "file:") return say("All of them show when the page is on a web server.");
    say("Loading all of them…");
    try {
      const response = await fetch(data.full);
      if (!response.ok) throw new Error(response.statusText || response.status);
      await stage.replace(new Uint8Array(await response.arrayBuffer()), true);
      if (crop.visible) crop.activate(true);
      await show();
      performance.mark("all Gaussians");
      say("All of them are shown.");
    } catch (error) {
      say(`The rest could not be loaded: ${error.message ?? error}.`);
    }
  }

  async function picture(camera) {
    await ready;
    try {
      return await stage.picture(camera);
    } finally {
      resize();
      orbit.moved();
    }
  }

  // The state of the view: the pose of the camera in the page's frame, column by column.
  function state() {
    const { camera } = stage;
    return {
      pose: camera.matrixWorld.toArray(), pivot: orbit.pivot.toArray(), fov: camera.fov, aspect: camera.aspect,
      near: camera.near, fade: stage.fade.value, active: gestures.active, current,
      photograph: comparison.camera?.name ?? null, lengths: measure.lengths,
      crop: crop.visible ? crop.box.map(Number) : null,
    };
  }

  async function settled() {
    await show();
    await stage.rested();
  }

  const ready = refine();
  const full = data.full ? complete() : ready;
  return { first, ready, full, look, picture, state, settled };
}
