// What the cameras saw, from their coarse depth maps, and how far the viewpoint may move from them.
// All coordinates are in the page's frame.

import * as THREE from "three";

const CLOSEST = 0.35; // the viewpoint's distance from the surface, as a multiple of the cameras'
const FARTHEST = 1.15; // its distance from the pivot, likewise
const BEHIND = 1.5; // a point this much deeper than the depth map is hidden
const BEFORE = 0.6; // one at less than this part of its depth is in the air
const MEETING = [0.7, 1.6]; // depths, likewise, at which the cameras' axes meet within an object
const ASIDE = 12; // degrees between a camera's axis and that point
const OPEN = 1.2; // the depth map of a camera that sees the viewpoint, as a multiple of its depth
const SLACK = [15, 45]; // degrees from the nearest camera's direction
const MAX_BOUNDED = 5000; // points that the hull is made of; more are thinned
const MAX_DIRECTIONS = 200; // of a pivot; more cameras are thinned
const RISE = 0.2; // above the highest camera and below the lowest, as a multiple of the pivot's depth
const POLE = 80; // largest elevation in degrees

const degrees = THREE.MathUtils.degToRad;
const fraction = (values, share) =>
  Float64Array.from(values).sort()[Math.min(Math.floor(values.length * share), values.length - 1)];

export class Coverage {
  // `cameras` have pinholes, `position` and `quaternion`; `depths` is data.depths, decoded.
  constructor(cameras, depths) {
    this.cameras = cameras;
    this.depths = depths;
    this.inverses = cameras.map(({ quaternion }) => quaternion.clone().invert());
    this.axes = cameras.map(({ quaternion }) => new THREE.Vector3(0, 0, -1).applyQuaternion(quaternion));
    this.meeting = this.#axesMeet();
    this.subject = cameras.flatMap((_, index) => this.#surface(index));
    const all = [...this.subject, ...cameras.map(({ position }) => position)];
    const median = axis => fraction(this.subject.map(point => point[axis]), 0.5) ?? 0;
    this.centre = new THREE.Vector3(median("x"), median("y"), median("z"));
    // Of the ball around the centre that holds most of what the cameras saw, and most cameras.
    const reach = points => fraction(points.map(p => p.distanceTo(this.centre)), 0.95) ?? 0;
    this.cameraReach = reach(cameras.map(({ position }) => position));
    this.reach = Math.max(reach(this.subject), this.cameraReach) || 1;
    const rise = RISE * (fraction(cameras.map((_, i) => this.pivotDepth(i) ?? 0), 0.5) ?? 0);
    const heights = cameras.map(({ position }) => position.y);
    this.heights = [Math.min(...heights) - rise, Math.max(...heights) + rise];
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

  // The point nearest to the cameras' axes in the least-squares sense; null if they are parallel.
  #axesMeet() {
    const matrix = new THREE.Matrix3().multiplyScalar(0), sum = new THREE.Vector3();
    this.cameras.forEach(({ position }, index) => {
      const axis = this.axes[index].toArray();
      const across = new THREE.Matrix3().set(
        ...axis.flatMap((a, i) => axis.map((b, j) => (i === j) - a * b)));
      across.elements.forEach((value, i) => { matrix.elements[i] += value; });
      sum.add(position.clone().applyMatrix3(across));
    });
    const determinant = matrix.determinant() / (this.cameras.length || 1) ** 3;
    return determinant > 1e-4 ? sum.applyMatrix3(matrix.invert()) : null;
  }

  // The depth at which to orbit in a camera's view: where the axes meet, if that is within what the
  // view shows, so that an object can be orbited all round; else the median depth.
  pivotDepth(index) {
    const median = this.#medianDepth(index);
    const { position } = this.cameras[index], axis = this.axes[index];
    if (median && this.meeting) {
      const offset = this.meeting.clone().sub(position), depth = offset.dot(axis);
      if (depth > MEETING[0] * median && depth < MEETING[1] * median
        && offset.angleTo(axis) < degrees(ASIDE)) return depth;
    }
    return median;
  }

  // The median depth in the central half of a camera's image; of all of it if nothing is there.
  #medianDepth(index) {
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
    const limit = 2 * this.#medianDepth(index), points = [];
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

  // The depth map's value where a camera's image shows a point, as a multiple of the point's depth;
  // null outside the image.
  #clearance(index, point) {
    const { fx, fy, cx, cy, position } = this.cameras[index];
    const local = point.clone().sub(position).applyQuaternion(this.inverses[index]);
    if (local.z >= 0) return null;
    const depth = this.depth(index, cx - fx * local.x / local.z, cy + fy * local.y / local.z);
    return depth === null ? null : depth / -local.z;
  }

  // Half-spaces that bound the cameras and what they saw.
  #hull(points) {
    const count = 48, every = Math.ceil(points.length / MAX_BOUNDED);
    const some = points.filter((_, i) => i % every === 0);
    this.planes = [...Array(count).keys()].map(i => {
      const z = 1 - (2 * i + 1) / count, angle = i * Math.PI * (3 - Math.sqrt(5));
      const normal = new THREE.Vector3(
        Math.sqrt(1 - z * z) * Math.cos(angle), z, Math.sqrt(1 - z * z) * Math.sin(angle));
      return { normal, offset: fraction(some.map(point => point.dot(normal)), 0.98) ?? 0 };
    });
  }

  // The distance of a point from the hull, as a multiple of the scene's reach; 0 inside.
  outside(point) {
    return Math.max(0, ...this.planes.map(({ normal, offset }) => point.dot(normal) - offset))
      / this.reach;
  }

  // The limits of a viewpoint around `pivot`, of the cameras that see it and of camera `own`; null
  // if there are none, or with `solid`, if the pivot is in the air.
  around(pivot, { own = null, solid = false } = {}) {
    let air = 0;
    const seen = this.cameras.flatMap(({ position }, index) => {
      const clearance = this.#clearance(index, pivot);
      if (index !== own && (clearance === null || clearance < 1 / BEHIND)) return [];
      air += clearance > 1 / BEFORE;
      return [{ position, free: Math.min(clearance ?? 1, 1) }];
    });
    return seen.length && !(solid && air > 0.4 * seen.length)
      ? new Limits(pivot, seen, { heights: this.heights }) : null;
  }

  // Whether a viewpoint that orbits `pivot` is in the open: not behind the surface that most cameras
  // on its side see there, nor close before it.
  isOpen(viewpoint, pivot) {
    const towards = viewpoint.clone().sub(pivot);
    const found = this.cameras.flatMap(({ position }, index) => {
      if (position.clone().sub(pivot).dot(towards) <= 0) return [];
      const clearance = this.#clearance(index, viewpoint);
      return clearance === null ? [] : [clearance];
    });
    return !found.length || fraction(found, 0.5) >= OPEN;
  }

  // The limits of the overview: all cameras, from farther away.
  overview() {
    const seen = this.cameras.map(({ position }) => ({ position, free: 1 }));
    return new Limits(this.centre, seen, {
      slack: 40, farthest: 3, least: 2.6 * this.reach,
    });
  }
}

class Limits {
  // `seen`: the `position` of each camera, and the part of the way to the pivot that is free.
  constructor(pivot, seen, { slack, farthest = FARTHEST, least = 0, heights } = {}) {
    const step = Math.ceil(seen.length / MAX_DIRECTIONS);
    this.cameras = seen.filter((_, i) => i % step === 0).map(({ position, free }) => {
      const direction = position.clone().sub(pivot), distance = direction.length() || 1e-9;
      direction.divideScalar(distance);
      return { direction, distance, closest: distance * (1 - (1 - CLOSEST) * free) };
    });
    this.farthest = farthest;
    this.least = least;
    this.pivot = pivot.clone();
    this.heights = heights;
    this.slack = degrees(slack ?? THREE.MathUtils.clamp(this.#gap(), ...SLACK));
  }

  // The median angle between neighbouring cameras, as seen from the pivot, in degrees.
  #gap() {
    const nearest = this.cameras.map((one, i) => Math.min(...this.cameras.map(
      (other, j) => i === j ? Math.PI : one.direction.angleTo(other.direction))));
    return THREE.MathUtils.radToDeg(fraction(nearest, 0.5) ?? 0);
  }

  // The offset of the viewpoint from the pivot that is nearest to `offset` within the limits.
  clamp(offset, up) {
    const direction = this.#turn(offset.clone().normalize(), up);
    const found = direction.clone().multiplyScalar(this.#distance(direction, offset.length()));
    if (this.heights) {
      const [low, high] = this.heights.map(height => height - this.pivot.y);
      found.y = THREE.MathUtils.clamp(found.y, low, high);
    }
    return found;
  }

  // Move `direction`, a unit vector from the pivot to the viewpoint, into the limits.
  #turn(direction, up) {
    let best = null, least = Infinity;
    for (const camera of this.cameras) {
      const angle = camera.direction.angleTo(direction);
      if (angle < least) [best, least] = [camera.direction, angle];
    }
    if (best && least > this.slack) {
      const axis = direction.clone().cross(best);
      if (axis.length() > 1e-6) direction.applyAxisAngle(axis.normalize(), least - this.slack);
    }
    const height = direction.dot(up), most = Math.sin(degrees(POLE));
    if (Math.abs(height) > most && !(best && Math.abs(best.dot(up)) > most)) {
      direction.addScaledVector(up, -height).setLength(Math.cos(degrees(POLE)));
      direction.addScaledVector(up, Math.sign(height) * most);
    }
    return direction;
  }

  // The allowed distance nearest to `distance`; cameras count less the farther aside they are.
  #distance(direction, distance) {
    let low = Infinity, high = this.least;
    for (const camera of this.cameras) {
      const aside = Math.max(camera.direction.angleTo(direction) / this.slack - 1, 0);
      const weight = Math.max(1 - 0.25 * aside, 0.3);
      low = Math.min(low, camera.closest / weight);
      high = Math.max(high, this.farthest * camera.distance * weight);
    }
    return high ? THREE.MathUtils.clamp(distance, Math.min(low, high), high) : distance;
  }
}
