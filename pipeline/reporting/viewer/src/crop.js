// A box that hides the Gaussians outside it, and the options that crop exported files like this.

import * as THREE from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";

const COLOUR = "#ffe14d";
const FACES = ["x0", "y0", "z0", "x1", "y1", "z1"]; // as in export.region

export class Crop extends LineSegments2 {
  // `panel` has a slider for each face. `box`, `bounds` of the sliders and `step` are in the frame and
  // unit of exported files, in which `unit` is one unit of the world; `frame` transforms the world to
  // the page's frame. `changed` is called with the least and the greatest corner in the world, or with
  // nothing without a box, and returns the number of Gaussians shown.
  constructor(panel, { box, bounds, step }, unit, frame, changed) {
    super(new LineSegmentsGeometry(),
      new LineMaterial({ color: COLOUR, linewidth: 1.5, transparent: true }));
    Object.assign(this, { panel, unit, changed, digits: Math.max(0, -Math.floor(Math.log10(step))) });
    frame.decompose(this.position, this.quaternion, this.scale);
    this.frustumCulled = false;
    FACES.forEach((name, i) => {
      const slider = panel.elements[name];
      Object.assign(slider, { min: bounds[i % 3], max: bounds[i % 3 + 3], step });
      slider.value = box[i];
      slider.addEventListener("input", () => this.#moved(i));
    });
    for (const button of panel.querySelectorAll("button"))
      button.addEventListener("click", () => copy(panel.elements[button.dataset.copies]));
    panel.addEventListener("submit", event => event.preventDefault());
    this.visible = false;
  }

  activate(active) {
    this.visible = active;
    this.panel.hidden = !active;
    if (active) this.#show();
    else this.changed();
  }

  // The faces as in export.region, with the digits of the slider's step.
  get box() {
    return FACES.map(name => Number(this.panel.elements[name].value).toFixed(this.digits));
  }

  // The opposite face makes room, up to its bound; a step is left between them.
  #moved(face) {
    const { elements } = this.panel, slider = elements[FACES[face]];
    const other = elements[FACES[(face + 3) % 6]], step = (face < 3 ? 1 : -1) * slider.step;
    const gap = () => (other.value - slider.value) / step;
    if (gap() < 1) other.value = Number(slider.value) + step;
    if (gap() < 1) slider.value = other.value - step;
    this.#show();
  }

  #show() {
    const { box, panel } = this;
    FACES.forEach((name, i) => {
      panel.elements[name].setAttribute("aria-valuetext", box[i]);
      panel.elements[name].nextElementSibling.textContent = box[i];
    });
    panel.elements.options.value = `export:\n  region: [${box.join(", ")}]`;
    panel.elements.command.value =
      `splatmake convert point_cloud.ply cropped.ply --box ${box.join(" ")}`;
    const corners = box.map(value => value / this.unit);
    const [low, high] = [corners.slice(0, 3), corners.slice(3)];
    this.geometry.setPositions(edges(low, high));
    const count = this.changed(low, high);
    panel.querySelector(".count").textContent = `${count.toLocaleString("en")} Gaussians in the box`;
  }
}

// The edges of a box: pairs of corners that differ in one coordinate.
function edges(low, high) {
  const corner = bits => low.map((value, axis) => (bits >> axis & 1 ? high[axis] : value));
  const found = [];
  for (let bits = 0; bits < 8; bits++)
    for (let axis = 0; axis < 3; axis++)
      if (!(bits >> axis & 1)) found.push(...corner(bits), ...corner(bits | 1 << axis));
  return found;
}

// Copy the text of a field, also where a page from a file may not use the clipboard.
function copy(field) {
  field.select();
  if (!navigator.clipboard) return document.execCommand("copy");
  return navigator.clipboard.writeText(field.value).catch(() => document.execCommand("copy"));
}
