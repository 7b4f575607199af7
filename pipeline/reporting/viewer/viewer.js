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
// Interactive view of the trained scene. ../space.py writes the page's elements and data for it;
// README.md describes how viewer.min.js is built from this file. There are two coordinate frames:
// the world, and the page's frame, in which y is up and the scene is in the unit box around the
// origin. data.frame transforms world coordinates to the page's frame.

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

const FAR = 1e4;
const CLICK_PX = 5; // a click moves the pointer by at most this
const HOVER_PX = 16; // the pointer selects a camera within this distance

const box = document.getElementById("space");
const tools = document.getElementById("space-tools");
const message = box.querySelector("p");

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

function start(data) {
  const canvas = box.querySelector("canvas");
  const label = box.querySelector("output");
  const renderer = new THREE.WebGLRenderer({ canvas });
  renderer.setClearColor(new THREE.Color().setRGB(...data.background, THREE.SRGBColorSpace));
  const scene = new THREE.Scene();
  const frame = new THREE.Matrix4().fromArray(data.frame);
  const near = data.near * frame.getMaxScaleOnAxis();
  // Shows the scene; `cameras` are those of the photographs.
  const viewCamera = new THREE.PerspectiveCamera(50, 1, near, FAR);
  const cameras = data.cameras.map(
    camera => ({ ...camera, ...poseInPage(camera.world_to_camera) }));

  // As splatmake's rasterizer: 3DGS's dilation, cutoff at alpha 1/255, sorted by depth.
  const spark = new SparkRenderer({
    renderer,
    onDirty: redraw,
    preBlurAmount: data.antialias ? 0 : 0.3,
    blurAmount: data.antialias ? 0.3 : 0,
    maxStdDev: Math.sqrt(2 * Math.log(255)),
    minAlpha: 1 / 255,
    maxPixelRadius: Infinity,
    sortRadial: false,
    accumExtSplats: true,
    enableLod: false,
  });
  const splats = new SplatMesh({
    fileBytes: bytes(document.getElementById("splats").textContent),
    extSplats: true,
  });
  frame.decompose(splats.position, splats.quaternion, splats.scale);
  const points = sparsePoints();
  points.visible = false;
  const frusta = new THREE.Group();
  scene.add(spark, splats, points, frusta);

  // Pose of a COLMAP camera in the page's frame, in three.js' convention: y up, looking along -z.
  function poseInPage(worldToCamera) {
    const pose = new THREE.Matrix4().set(...worldToCamera, 0, 0, 0, 1).invert()
      .multiply(new THREE.Matrix4().makeScale(1, -1, -1)).premultiply(frame);
    const position = new THREE.Vector3(), quaternion = new THREE.Quaternion();
    pose.decompose(position, quaternion, new THREE.Vector3());
    return { position, quaternion };
  }

  function sparsePoints() {
    const geometry = new THREE.BufferGeometry();
    const xyz = new Int16Array(bytes(data.points).buffer);
    geometry.setAttribute("position", new THREE.BufferAttribute(xyz, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(bytes(data.colours), 3, true));
    const material = new THREE.PointsMaterial({ size: 0.02, vertexColors: true });
    // The colours are sRGB already: no conversion.
    material.onBeforeCompile = shader => {
      shader.fragmentShader = shader.fragmentShader.replace("#include <colorspace_fragment>", "");
    };
    const points = new THREE.Points(geometry, material);
    points.scale.setScalar(data.step);
    points.frustumCulled = false;
    return points;
  }

  // Draw a pyramid for each camera, except cameras close to viewCamera, which would block its view.
  function drawFrusta() {
    for (const { geometry, material } of frusta.children) {
      geometry.dispose();
      material.dispose();
    }
    frusta.clear();
    const style = getComputedStyle(box);
    for (const test of [false, true]) {
      const corners = [];
      for (const camera of cameras) {
        const close = camera.position.distanceTo(viewCamera.position) < 8 * data.size;
        if (close || camera.test !== test) continue;
        const { width, height, fx, fy, cx, cy, position, quaternion } = camera;
        const depth = 2 * data.size / Math.max(width / fx, height / fy);
        const [a, b, c, d] = [[0, 0], [width, 0], [width, height], [0, height]].map(([x, y]) =>
          new THREE.Vector3((x - cx) / fx, (cy - y) / fy, -1).multiplyScalar(depth)
            .applyQuaternion(quaternion).add(position));
        for (const end of [a, b, c, d]) corners.push(...position, ...end);
        for (const [from, to] of [[a, b], [b, c], [c, d], [d, a]]) corners.push(...from, ...to);
      }
      const color = style.getPropertyValue(test ? "--test" : "--train").trim();
      if (corners.length) frusta.add(new LineSegments2(
        new LineSegmentsGeometry().setPositions(corners),
        new LineMaterial({ color, linewidth: 1.5, depthTest: false, transparent: true })));
    }
    redraw();
  }

  let requested = false, busy = false;
  function redraw() {
    if (requested || busy) return;
    requested = true;
    requestAnimationFrame(() => {
      requested = false;
      if (!busy) renderer.render(scene, viewCamera);
    });
  }

  // Half the square root of the visible area at depth 1. It does not depend on the window's shape.
  let spread = 0.5;
  function resize() {
    const { clientWidth: width, clientHeight: height } = box;
    if (busy || !width || !height) return;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    viewCamera.aspect = width / height;
    viewCamera.fov = 2 * THREE.MathUtils.radToDeg(Math.atan(spread / Math.sqrt(viewCamera.aspect)));
    viewCamera.updateProjectionMatrix();
    redraw();
  }

  // Orbit around a point in front of viewCamera, with an up axis that does not change the view.
  let controls;
  function orbitAround(target, up) {
    controls?.dispose();
    viewCamera.up.copy(up);
    controls = new OrbitControls(viewCamera, canvas);
    controls.target.copy(target);
    controls.minDistance = 2 * near;
    controls.maxDistance = 100;
    controls.zoomToCursor = true;
    controls.update();
    controls.addEventListener("change", redraw);
    controls.addEventListener("end", drawFrusta);
  }

  function showCamera(index) {
    const { position, quaternion, width, height, fx, fy } = cameras[index];
    const axis = (x, y, z) => new THREE.Vector3(x, y, z).applyQuaternion(quaternion);
    const right = axis(1, 0, 0), forward = axis(0, 0, -1);
    const up = new THREE.Vector3(0, 1, 0).addScaledVector(right, -right.y);
    if (up.length() < 0.3 || Math.abs(up.normalize().dot(forward)) > 0.97) up.copy(axis(0, 1, 0));
    viewCamera.position.copy(position);
    spread = Math.sqrt(width / fx * height / fy) / 2;
    const ahead = Math.max(-position.dot(forward), 0.3);
    orbitAround(forward.multiplyScalar(ahead).add(position), up);
    tools.elements.view.value = index;
    drawFrusta();
    resize();
  }

  function showOverview() {
    const mean = new THREE.Vector3(0, 0, -1e-3);
    for (const { quaternion } of cameras)
      mean.add(new THREE.Vector3(0, 0, -1).applyQuaternion(quaternion));
    const yaw = Math.atan2(mean.x, mean.z) + 0.5;
    viewCamera.position.set(-Math.sin(yaw), 0.5, -Math.cos(yaw)).multiplyScalar(2.6);
    spread = 0.5;
    orbitAround(new THREE.Vector3(), new THREE.Vector3(0, 1, 0));
    tools.elements.view.value = "";
    drawFrusta();
    resize();
  }

  function look(value) {
    if (value === "") showOverview();
    else showCamera(Number(value));
  }

  function cameraAt(event) {
    let found = null, reach = HOVER_PX;
    const bounds = canvas.getBoundingClientRect();
    const pointer = [event.clientX - bounds.left, event.clientY - bounds.top];
    if (frusta.visible) cameras.forEach(({ position }, index) => {
      const at = position.clone().project(viewCamera);
      const x = (at.x + 1) / 2 * bounds.width, y = (1 - at.y) / 2 * bounds.height;
      const distance = Math.hypot(x - pointer[0], y - pointer[1]);
      if (Math.abs(at.z) < 1 && distance < reach) {
        reach = distance;
        found = { index, x, y };
      }
    });
    return found;
  }

  let pressed = [0, 0];
  canvas.addEventListener("pointerdown", event => { pressed = [event.clientX, event.clientY]; });
  canvas.addEventListener("pointermove", event => {
    const found = event.buttons ? null : cameraAt(event);
    label.textContent = found ? cameras[found.index].name : "";
    canvas.style.cursor = found ? "pointer" : "";
    if (found) Object.assign(label.style, { left: `${found.x}px`, top: `${found.y}px` });
  });
  canvas.addEventListener("pointerleave", () => { label.textContent = ""; });
  canvas.addEventListener("click", event => {
    if (Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > CLICK_PX) return;
    const found = cameraAt(event);
    if (found) showCamera(found.index);
  });
  // The wheel scrolls the page until the scene has been clicked.
  canvas.addEventListener("wheel", event => {
    if (document.activeElement !== canvas) event.stopImmediatePropagation();
  }, { capture: true });
  canvas.addEventListener("keydown", event => {
    const [x, y] = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[
      event.key] ?? [0, 0];
    if (x || y) {
      if (event.shiftKey) controls.pan(40 * x, 40 * y);
      else { controls.rotateLeft(0.08 * x); controls.rotateUp(0.08 * y); }
    } else if (event.key === "+" || event.key === "=") controls.dollyIn(1.1);
    else if (event.key === "-") controls.dollyOut(1.1);
    else if (event.key === "Escape") canvas.blur();
    else return;
    event.preventDefault();
  });
  tools.addEventListener("submit", event => event.preventDefault());
  tools.addEventListener("change", () => {
    const { show, cameras } = tools.elements;
    frusta.visible = cameras.checked;
    points.visible = show.value === "points";
    splats.visible = !points.visible;
    redraw();
  });
  tools.elements.view.addEventListener("change", event => look(event.target.value));
  tools.elements.previous.addEventListener("click", () => step(-1));
  tools.elements.next.addEventListener("click", () => step(1));
  function step(by) {
    const { view } = tools.elements;
    view.selectedIndex = (view.selectedIndex + by + view.length) % view.length;
    look(view.value);
  }
  tools.elements.full.hidden = !box.requestFullscreen;
  tools.elements.full.addEventListener("click", () => box.requestFullscreen());
  new ResizeObserver(resize).observe(box);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawFrusta);

  // Wait until the splats are coloured and sorted for this camera.
  async function settled(camera) {
    const idle = async () => {
      while (spark.sorting || spark.sortDirty) await new Promise(done => setTimeout(done, 5));
    };
    await idle();
    await spark.update({ scene, camera });
    await idle();
  }

  look(data.start === null ? "" : data.start);
  const ready = splats.initialized.then(() => settled(viewCamera)).then(() => {
    message.hidden = true;
    tools.firstElementChild.disabled = false;
    redraw();
  });

  // Render the splats alone; returns the data URL of a PNG. The camera is a pinhole in world
  // coordinates with the fields of data.cameras.
  async function picture({ width, height, fx, fy, cx, cy, world_to_camera }) {
    await ready;
    const camera = new THREE.PerspectiveCamera();
    Object.assign(camera, { near, far: FAR });
    const { position, quaternion } = poseInPage(world_to_camera);
    camera.position.copy(position);
    camera.quaternion.copy(quaternion);
    camera.updateMatrixWorld();
    camera.projectionMatrix.set(
      2 * fx / width, 0, 1 - 2 * cx / width, 0,
      0, 2 * fy / height, 2 * cy / height - 1, 0,
      0, 0, (near + FAR) / (near - FAR), 2 * near * FAR / (near - FAR),
      0, 0, -1, 0);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    const shown = [splats, points, frusta].map(object => object.visible);
    busy = true;
    try {
      [splats, points, frusta].forEach(object => { object.visible = object === splats; });
      renderer.setPixelRatio(1);
      renderer.setSize(width, height, false);
      await settled(camera);
      renderer.render(scene, camera);
      return canvas.toDataURL("image/png");
    } finally {
      busy = false;
      [splats, points, frusta].forEach((object, i) => { object.visible = shown[i]; });
      resize();
    }
  }

  return { ready, look, picture };
}

function bytes(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), out = new Uint8Array(text.length);
  for (let i = 0; i < out.length; i++) out[i] = text.charCodeAt(i);
  return out;
}
