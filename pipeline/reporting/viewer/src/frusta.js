// The cameras of the photographs as pyramids.

import * as THREE from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";

const HOVER_PX = 16; // the pointer selects a camera within this distance
const LARGEST = 0.12; // of a pyramid, as a multiple of its distance from the viewpoint

export class Frusta extends THREE.Group {
  // `size` is that of a pyramid; `style` has the colours --train and --test.
  constructor(cameras, size, style) {
    super();
    Object.assign(this, { cameras, size, style });
  }

  // Draw the pyramids, except of a camera that one looks through. Those near `viewpoint` are
  // smaller, so that they do not block the view.
  draw(viewpoint) {
    for (const { geometry, material } of this.children) {
      geometry.dispose();
      material.dispose();
    }
    this.clear();
    if (!this.visible) return;
    for (const test of [false, true]) {
      const corners = [];
      for (const camera of this.cameras) {
        const distance = camera.position.distanceTo(viewpoint);
        if (camera.test !== test || distance < 1e-4) continue;
        corners.push(...pyramid(camera, Math.min(this.size, LARGEST * distance)));
      }
      const color = this.style.getPropertyValue(test ? "--test" : "--train").trim();
      if (!corners.length) continue;
      const lines = new LineSegments2(
        new LineSegmentsGeometry().setPositions(corners),
        new LineMaterial({ color, linewidth: 1.5, depthTest: false, transparent: true }));
      lines.frustumCulled = false;
      lines.renderOrder = 1;
      this.add(lines);
    }
  }

  // The camera at a position on the canvas, in pixels, with where it is drawn; or null.
  at(x, y, viewCamera, { clientWidth, clientHeight }) {
    let found = null, reach = HOVER_PX;
    if (this.visible) this.cameras.forEach(({ position }, index) => {
      const point = position.clone().project(viewCamera);
      const left = (point.x + 1) / 2 * clientWidth, top = (1 - point.y) / 2 * clientHeight;
      const distance = Math.hypot(left - x, top - y);
      if (Math.abs(point.z) < 1 && distance < reach) {
        reach = distance;
        found = { index, left, top };
      }
    });
    return found;
  }
}

function pyramid({ width, height, fx, fy, cx, cy, position, quaternion }, size) {
  const depth = 2 * size / Math.max(width / fx, height / fy), lines = [];
  const ends = [[0, 0], [width, 0], [width, height], [0, height]].map(([x, y]) =>
    new THREE.Vector3((x - cx) / fx, (cy - y) / fy, -1).multiplyScalar(depth)
      .applyQuaternion(quaternion).add(position));
  ends.forEach((end, i) => lines.push(...position, ...end, ...end, ...ends[(i + 1) % 4]));
  return lines;
}
