// Where rays meet the surface that Gaussians show.

import * as THREE from "three";

const BLUR = Math.sqrt(0.3); // pixels; the rasterizer's dilation
const LEAST_ALPHA = 1 / 255;
const CUTOFF = Math.sqrt(2 * Math.log(255)); // standard deviations at which alpha is the least
const NUMBERS = 11; // of a Gaussian: mean, standard deviations, quaternion, opacity
// Of the light. The first Gaussians that show are on the surface; what shines through them comes from
// Gaussians inside, so that the depth at which half of the light is absorbed is too large.
const ABSORBED = 0.2;

export class Surface {
  // Of a SplatMesh that is initialized.
  constructor(mesh) {
    this.mesh = mesh;
    const values = this.values = new Float32Array(mesh.splats.getNumSplats() * NUMBERS);
    mesh.forEachSplat((index, mean, sigmas, { x, y, z, w }, opacity) => values.set(
      [mean.x, mean.y, mean.z, sigmas.x, sigmas.y, sigmas.z, x, y, z, w, opacity],
      index * NUMBERS));
  }

  // The number of Gaussians that count, by `isShown` as below.
  count(isShown) {
    let found = 0;
    for (let at = 0; at < this.values.length; at += NUMBERS)
      found += isShown(this.values[at], this.values[at + 1], this.values[at + 2]);
    return found;
  }

  // The distance along each ray at which the share ABSORBED of its light is; null for rays of which
  // less is. A ray meets a Gaussian where the Gaussian's density along it is largest. `rays` have one
  // origin and about one direction; `pixel` is the angle that a pixel spans. `isShown(x, y, z)` says
  // of a mean, in the mesh's coordinates, whether the Gaussian counts.
  depths(rays, near, pixel, isShown) {
    const inverse = this.mesh.matrixWorld.clone().invert();
    const unit = this.mesh.matrixWorld.getMaxScaleOnAxis();
    const local = rays.map(ray => ray.clone().applyMatrix4(inverse));
    const { origin } = local[0], axis = local[0].direction;
    const spread = Math.max(...local.map(({ direction }) => direction.angleTo(axis)));
    const met = rays.map(() => []), mean = new THREE.Vector3();
    for (let at = 0; at < this.values.length; at += NUMBERS) {
      mean.fromArray(this.values, at).sub(origin);
      const ahead = mean.dot(axis), aside = Math.sqrt(Math.max(mean.lengthSq() - ahead ** 2, 0));
      const largest = Math.max(this.values[at + 3], this.values[at + 4], this.values[at + 5]);
      const reach = CUTOFF * (largest + BLUR * pixel * Math.abs(ahead)) + spread * Math.abs(ahead);
      if (aside > reach || ahead < -reach) continue;
      if (!isShown(this.values[at], this.values[at + 1], this.values[at + 2])) continue;
      local.forEach(({ direction }, index) => {
        const hit = this.#hit(at, mean, direction, BLUR * pixel * ahead);
        if (hit && hit.depth * unit > near) met[index].push(hit);
      });
    }
    return met.map(hits => {
      const depth = front(hits);
      return depth === null ? null : depth * unit;
    });
  }

  // Where a ray from the origin meets a Gaussian, which is at `mean` from there, and its alpha.
  #hit(at, mean, direction, blur) {
    const turn = quaternion.fromArray(this.values, at + 6).conjugate();
    const from = offset.copy(mean).negate().applyQuaternion(turn);
    const along = way.copy(direction).applyQuaternion(turn);
    for (const [i, axis] of ["x", "y", "z"].entries()) {
      const sigma = Math.hypot(this.values[at + 3 + i], blur);
      from[axis] /= sigma;
      along[axis] /= sigma;
    }
    const depth = -from.dot(along) / along.lengthSq();
    const alpha = this.values[at + 10] * Math.exp(-from.addScaledVector(along, depth).lengthSq() / 2);
    return alpha < LEAST_ALPHA ? null : { depth, alpha };
  }
}

const quaternion = new THREE.Quaternion(), offset = new THREE.Vector3(), way = new THREE.Vector3();

function front(hits) {
  hits.sort((a, b) => a.depth - b.depth);
  let left = 1;
  for (const { depth, alpha } of hits) {
    left *= 1 - alpha;
    if (left <= 1 - ABSORBED) return depth;
  }
  return null;
}
