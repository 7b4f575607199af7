// Moves a three.js camera around a pivot, within limits; flies from one view to another.

import * as THREE from "three";

const FLIGHT_MS = 450;

export class Orbit {
  // `moved` is called after each move.
  constructor(camera, coverage, moved) {
    Object.assign(this, { camera, coverage, moved });
    this.pivot = new THREE.Vector3();
    this.up = new THREE.Vector3(0, 1, 0);
    this.limits = null;
    this.flight = 0;
    this.panned = false; // since the pivot was last on the surface
  }

  // Show a view: `position`, `pivot`, `up`, `limits`. It lies within the limits.
  show(view, animate) {
    cancelAnimationFrame(this.flight);
    const from = { position: this.camera.position.clone(), pivot: this.pivot.clone(), up: this.up };
    const still = !animate || matchMedia("(prefers-reduced-motion: reduce)").matches
      || this.#apart(from, view) > Math.PI / 2;
    this.limits = view.limits;
    const end = () => {
      this.#place(view.position, view.pivot, view.up);
      view.arrived?.();
    };
    if (still) return end();
    const start = performance.now();
    const step = now => {
      const t = THREE.MathUtils.smoothstep((now - start) / FLIGHT_MS, 0, 1);
      if (t >= 1) return end();
      this.#place(from.position.clone().lerp(view.position, t),
        from.pivot.clone().lerp(view.pivot, t), from.up.clone().lerp(view.up, t).normalize());
      this.flight = requestAnimationFrame(step);
    };
    this.flight = requestAnimationFrame(step);
  }

  // The angle between the viewing directions of two views; one flies only between similar ones.
  #apart(a, b) {
    return a.pivot.clone().sub(a.position).angleTo(b.pivot.clone().sub(b.position));
  }

  #place(position, pivot, up) {
    this.pivot.copy(pivot);
    this.up.copy(up);
    this.camera.up.copy(up);
    this.camera.position.copy(position);
    this.camera.lookAt(pivot);
    this.camera.updateMatrixWorld();
    this.moved();
  }

  #offset() {
    return this.camera.position.clone().sub(this.pivot);
  }

  // Go to `offset` from `pivot`, or as near to it as the limits allow. Return false, without moving,
  // if that is not in the open.
  #go(offset, pivot = this.pivot, limits = this.limits) {
    const position = this.#allowed(offset, pivot, limits);
    if (!position) return false;
    this.limits = limits;
    this.#place(position, pivot.clone(), this.up.clone());
    return true;
  }

  // The position that the limits allow; null if it is not in the open.
  #allowed(offset, pivot, limits) {
    if (!limits) return offset.clone().add(pivot);
    const position = limits.clamp(offset, this.up).add(pivot);
    return limits.heights && !this.coverage.isOpen(position, pivot) ? null : position;
  }

  // Angles in radians: to the right, and upwards.
  rotate(right, upwards) {
    cancelAnimationFrame(this.flight);
    const offset = this.#offset().applyAxisAngle(this.up, right);
    const side = this.up.clone().cross(offset).normalize();
    const angle = offset.angleTo(this.up);
    const pitch = THREE.MathUtils.clamp(upwards, angle - Math.PI + 0.05, angle - 0.05);
    this.#go(offset.applyAxisAngle(side, -pitch));
  }

  zoom(factor) {
    cancelAnimationFrame(this.flight);
    this.#go(this.#offset().multiplyScalar(factor));
  }

  // Move the pivot and the viewpoint in the image plane, in multiples of the view's height; not
  // into the air, nor to where no camera looked.
  pan(x, y) {
    cancelAnimationFrame(this.flight);
    const offset = this.#offset();
    const height = 2 * offset.length() * Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
    const axis = column => new THREE.Vector3().setFromMatrixColumn(this.camera.matrixWorld, column);
    const pivot = this.pivot.clone()
      .addScaledVector(axis(0), -x * height).addScaledVector(axis(1), y * height);
    const limits = this.coverage.around(pivot, { solid: true });
    if (!limits) return;
    if (this.#go(offset, pivot, limits)) this.panned = true;
  }

  // After panning, orbit around `point`, which is on the view's axis, if its limits allow this view.
  recentre(point) {
    const limits = this.panned && point && this.coverage.around(point);
    this.panned = false;
    if (!limits) return;
    const offset = this.camera.position.clone().sub(point);
    if (limits.clamp(offset, this.up).distanceTo(offset) > 1e-3 * offset.length()) return;
    this.pivot.copy(point);
    this.limits = limits;
  }

  // Orbit around `point`, a point of the scene, and look at it from `share` of the distance.
  focus(point, share, animate) {
    const limits = this.coverage.around(point);
    if (!limits) return false;
    const offset = this.camera.position.clone().sub(point).multiplyScalar(share);
    const position = this.#allowed(offset, point, limits);
    if (!position) return false;
    this.show({ position, pivot: point, up: this.up.clone(), limits }, animate);
    return true;
  }
}
