// Spark draws one quad per instance. Renderers in software, and some GPUs, spend more on an instance
// than on its Gaussian, so that here an instance has a batch of quads.

import * as THREE from "three";
import { changeShader } from "./projection.js";

const BATCH = 4096; // quads: four vertices of each fit into 16-bit indices

const CHANGES = [
  ["void main() {", shader => `uniform int splatsDrawn;
    ${shader}
    int splatRank = gl_InstanceID * ${BATCH} + int(position.z);`],
  ["uint splatIndex = texelFetch(ordering, orderingCoord, 0)[gl_InstanceID & 3];", shader => `
    if (splatRank >= splatsDrawn) return;
    ${shader.replace("gl_InstanceID", "splatRank")}`],
  ["ivec2((gl_InstanceID >> 2) & 4095, gl_InstanceID >> 14)", shader =>
    shader.replaceAll("gl_InstanceID", "splatRank")],
];

// Changes a SparkRenderer; throws if Spark has another shader.
export function drawInBatches(spark) {
  changeShader(spark, CHANGES);
  const splatsDrawn = spark.material.uniforms.splatsDrawn = { value: 0 };
  spark.geometry.dispose();
  spark.geometry = batch();
  const { onBeforeRender } = spark;
  spark.onBeforeRender = (...args) => {
    onBeforeRender.apply(spark, args);
    splatsDrawn.value = spark.activeSplats;
    spark.geometry.instanceCount = Math.ceil(spark.activeSplats / BATCH);
  };
}

// Quads whose vertices have the quad's number as their third coordinate.
function batch() {
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]], triangles = [0, 1, 2, 0, 2, 3];
  const positions = new Float32Array(BATCH * 12), indices = new Uint16Array(BATCH * 6);
  for (let quad = 0; quad < BATCH; quad++) {
    corners.forEach(([x, y], i) => positions.set([x, y, quad], 12 * quad + 3 * i));
    triangles.forEach((corner, i) => { indices[6 * quad + i] = 4 * quad + corner; });
  }
  const geometry = new THREE.InstancedBufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setIndex(new THREE.BufferAttribute(indices, 1));
  geometry.instanceCount = 0;
  return geometry;
}
