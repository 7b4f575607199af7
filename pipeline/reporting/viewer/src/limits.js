// What the cameras saw, from their coarse depth maps, and how far the viewpoint may move from them.
// All coordinates are in the page's frame.

import * as THREE from "three";

const CLOSEST = 0.35; // the viewpoint's distance from the pivot, as a multiple of the cameras'
const FARTHEST = 1.15;
const BEHIND = 1.35; // a point this much deeper than the depth map is hidden
const SLACK = [15, 45]; // degrees from the nearest camera's direction
const MAX_DIRECTIONS = 200; // of a pivot; more cameras are thinned
const POLE = 0.985; // largest cosine between the up axis and the direction to the viewpoint

const degrees = THREE.MathUtils.degToRad;
const fraction = (values, share) =>
  values.slice().sort((a, b) => a - b)[Math.min(Math.floor(values.length * share), values.length - 1)];

export class Coverage {
  // `cameras` have pinholes, `position` and `quaternion`; `depths` is data.depths, decoded.
  constructor(cameras, depths) {
    this.cameras = cameras;
    this.depths = depths;
    this.inverses = cameras.map(({ quaternion }) => quaternion.clone().invert());
    this.subject = cameras.flatMap((_, index) => this.#surface(index));
    const all = [...this.subject, ...cameras.map(({ position }) => position)];
    const median = axis => fraction(this.subject.map(point => point[axis]), 0.5) ?? 0;
    this.centre = new THREE.Vector3(median("x"), median("y"), median("z"));
    // Of the ball around the centre that holds most of what the cameras saw, and most cameras.
    const reach = points => fraction(points.map(p => p.distanceTo(this.centre)), 0.95) ?? 0;
    this.cameraReach = reach(cameras.map(({ position }) => position));
    this.reach = Math.max(reach(this.subject), this.cameraReach) || 1;
    this.#hull(all);
  }

  depth(index, x, y) {
    const { rows, columns, codes, first, ratio } = this.depths;
    const { width, height } = this.cameras[index];
    const row = Math.floor(y / height * rows), column = Math.floor(x / width * columns);
    if (row < 0 || column < 0 || row >= rows || column >= columns) return null;
    const code = codes[(index * rows + row) * columns + column];
    return code ? first * ratio ** (code - 1) : Infinity;
  }

  // The median depth in the central half of a camera's image; of all of it if nothing is there.
  pivotDepth(index) {
    const { width, height } = this.cameras[index];
    for (const margin of [0.3, 0]) {
      const found = [];
      for (let y = margin + 0.03; y < 1 - margin; y += 0.06)
        for (let x = margin + 0.03; x < 1 - margin; x += 0.06)
          found.push(this.depth(index, x * width, y * height));
      const finite = found.filter(Number.isFinite);
      if (finite.length > found.length / 8) return fraction(finite, 0.5);
    }
    return null;
  }

  // The centres of a camera's cells on its depth map, without what is far behind its pivot.
  #surface(index) {
    const { rows, columns } = this.depths;
    const { width, height, fx, fy, cx, cy, position, quaternion } = this.cameras[index];
    const limit = 2 * this.pivotDepth(index), points = [];
    for (let row = 0; row < rows; row++)
      for (let column = 0; column < columns; column++) {
        const x = (column + 0.5) / columns * width, y = (row + 0.5) / rows * height;
        const depth = this.depth(index, x, y);
        if (depth <= limit) points.push(
          new THREE.Vector3((x - cx) / fx, (cy - y) / fy, -1).multiplyScalar(depth)
            .applyQuaternion(quaternion).add(position));
      }
    return points;
  }

  sees(index, point) {
    const { fx, fy, cx, cy, position } = this.cameras[index];
    const local = point.clone().sub(position).applyQuaternion(this.inverses[index]);
    if (local.z >= 0) return false;
    const depth = this.depth(index, cx - fx * local.x / local.z, cy + fy * local.y / local.z);
    return depth !== null && -local.z <= BEHIND * depth;
  }

  // Half-spaces that bound the cameras and what they saw.
  #hull(points) {
    const count = 48;
    this.planes = [...Array(count).keys()].map(i => {
      const z = 1 - (2 * i + 1) / count, angle = i * Math.PI * (3 - Math.sqrt(5));
      const normal = new THREE.Vector3(
        Math.sqrt(1 - z * z) * Math.cos(angle), z, Math.sqrt(1 - z * z) * Math.sin(angle));
      return { normal, offset: fraction(points.map(point => point.dot(normal)), 0.98) ?? 0 };
    });
  }

  // The distance of a point from the hull, as a multiple of the scene's reach; 0 inside.
  outside(point) {
    return Math.max(0, ...this.planes.map(({ normal, offset }) => point.dot(normal) - offset))
      / this.reach;
  }

  // The limits of a viewpoint around `pivot`, of the cameras that see it and of camera `own`; null
  // if there are none.
  around(pivot, own = null) {
    const seen = this.cameras.flatMap((_, index) =>
      index === own || this.sees(index, pivot) ? [index] : []);
    return seen.length ? new Limits(pivot, seen.map(index => this.cameras[index].position), {}) : null;
  }

  // The limits of the overview: all cameras, from farther away.
  overview() {
    const positions = this.cameras.map(({ position }) => position);
    return new Limits(this.centre, positions, { slack: 40, farthest: 3, least: 2.6 * this.reach });
  }
}

class Limits {
  constructor(pivot, positions, { slack, farthest = FARTHEST, least = 0 }) {
    const step = Math.ceil(positions.length / MAX_DIRECTIONS);
    this.directions = positions.filter((_, i) => i % step === 0 || i === positions.length - 1)
      .map(position => position.clone().sub(pivot)).filter(offset => offset.length() > 1e-9);
    this.distances = this.directions.map(offset => offset.length());
    this.directions.forEach(offset => offset.normalize());
    this.farthest = farthest;
    this.least = least;
    this.slack = degrees(slack ?? THREE.MathUtils.clamp(this.#gap(), ...SLACK));
  }

  // The median angle between neighbouring cameras, as seen from the pivot, in degrees.
  #gap() {
    const nearest = this.directions.map((one, i) =>
      Math.min(...this.directions.map((other, j) => i === j ? Math.PI : one.angleTo(other))));
    return THREE.MathUtils.radToDeg(fraction(nearest, 0.5) ?? 0);
  }

  // Move `direction`, a unit vector from the pivot to the viewpoint, into the limits.
  turn(direction, up) {
    let best = null, least = Infinity;
    for (const camera of this.directions) {
      const angle = camera.angleTo(direction);
      if (angle < least) [best, least] = [camera, angle];
    }
    if (best && least > this.slack) {
      const axis = direction.clone().cross(best);
      if (axis.length() > 1e-6) direction.applyAxisAngle(axis.normalize(), least - this.slack);
    }
    const height = direction.dot(up);
    if (Math.abs(height) > POLE && (!best || Math.abs(best.dot(up)) <= POLE)) {
      const flat = direction.clone().addScaledVector(up, -height).normalize();
      direction.copy(flat.multiplyScalar(Math.sqrt(1 - POLE ** 2)))
        .addScaledVector(up, Math.sign(height) * POLE);
    }
    return direction;
  }

  // The allowed distance nearest to `distance`; cameras count less the farther aside they are.
  distance(direction, distance) {
    let low = Infinity, high = this.least;
    this.directions.forEach((camera, i) => {
      const aside = Math.max(camera.angleTo(direction) / this.slack - 1, 0);
      const weight = Math.max(1 - 0.25 * aside, 0.3);
      low = Math.min(low, CLOSEST * this.distances[i] / weight);
      high = Math.max(high, this.farthest * this.distances[i] * weight);
    });
    return high ? THREE.MathUtils.clamp(distance, Math.min(low, high), high) : distance;
  }
}
