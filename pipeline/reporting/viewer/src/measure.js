// Measures the distance between two points of the surface.

import * as THREE from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";

const COLOUR = "#ffe14d";
const POINT_PX = 9;
const DIGITS = 4;

export class Measure extends THREE.Group {
  // `output` shows the result. Lengths in the page's frame, whose y axis is the world's up, times
  // `factor` are in `unit`.
  constructor(output, factor, unit) {
    super();
    Object.assign(this, { output, factor, unit, active: false, ends: [] });
    this.#show();
  }

  // Start without points, or end.
  activate(active) {
    this.active = active;
    this.ends = [];
    this.#show();
  }

  // The next point, null where there is no surface. After two, a new measurement begins.
  choose(point) {
    if (this.ends.length === 2) this.ends = [];
    if (point) this.ends.push(point);
    this.#show(!point);
  }

  // Distance, height of the second point above the first, and horizontal distance; null without two
  // points.
  get lengths() {
    if (this.ends.length < 2) return null;
    const { x, y, z } = this.ends[1].clone().sub(this.ends[0]).multiplyScalar(this.factor);
    return { distance: Math.hypot(x, y, z), height: y, horizontal: Math.hypot(x, z) };
  }

  #show(missed = false) {
    this.#draw();
    this.output.textContent = !this.active ? "" : missed ? "No surface there: choose another point"
      : this.lengths ? this.#text(this.lengths)
        : `${this.ends.length ? "Second" : "First"} point: click it, or Enter for the middle`;
  }

  #text({ distance, height, horizontal }) {
    const number = value =>
      Number(value.toPrecision(DIGITS)).toLocaleString("en", { maximumFractionDigits: 12 });
    return `${number(distance)} ${this.unit}: ${number(Math.abs(height))} in height, `
      + `${number(horizontal)} horizontally`;
  }

  #draw() {
    for (const { geometry, material } of this.children) {
      geometry.dispose();
      material.dispose();
    }
    this.clear();
    if (!this.ends.length) return;
    const common = { color: COLOUR, depthTest: false, transparent: true };
    this.#place(new THREE.Points(new THREE.BufferGeometry().setFromPoints(this.ends),
      new THREE.PointsMaterial({ ...common, size: POINT_PX, sizeAttenuation: false })));
    if (this.ends.length < 2) return;
    const [from, to] = this.ends, corner = new THREE.Vector3(to.x, from.y, to.z);
    const lines = (points, more) => this.#place(new LineSegments2(
      new LineSegmentsGeometry().setPositions(points.flatMap(point => point.toArray())),
      new LineMaterial({ ...common, ...more })));
    lines([from, to], { linewidth: 2.5 });
    lines([from, corner, corner, to], { linewidth: 1.2, opacity: 0.7 });
  }

  #place(object) {
    object.frustumCulled = false;
    object.renderOrder = 2;
    this.add(object);
  }
}
