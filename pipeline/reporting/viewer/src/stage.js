// The scene in WebGL: Gaussians, sparse points, and the frame that the page shows them in.

import * as THREE from "three";
import { dyno, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

import { drawInBatches } from "./batches.js";
import { projectAsRasterizer } from "./projection.js";
import { Resolution } from "./resolution.js";
import { Surface } from "./surface.js";

const FAR = 1e4;
// Gaussians fade between these multiples of the scene's reach when the viewpoint leaves its hull.
const FADE = [1.1, 1.6];
const STILL_AFTER = 200; // ms without a movement
const FINER = 1.1; // the least step between resolutions of a view that is still
const DRAWN = 5e5, DRAWN_BY_PHONES = 2e5; // Gaussians at once of a file beside the page

const pause = () => new Promise(done => setTimeout(done, 5));

export function bytes(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), out = new Uint8Array(text.length);
  for (let i = 0; i < out.length; i++) out[i] = text.charCodeAt(i);
  return out;
}

// Pose of a COLMAP camera in the page's frame, in three.js' convention: y up, looking along -z.
export function poseInPage(worldToCamera, frame) {
  const pose = new THREE.Matrix4().set(...worldToCamera, 0, 0, 0, 1).invert()
    .multiply(new THREE.Matrix4().makeScale(1, -1, -1)).premultiply(frame);
  const position = new THREE.Vector3(), quaternion = new THREE.Quaternion();
  pose.decompose(position, quaternion, new THREE.Vector3());
  return { position, quaternion };
}

export class Stage {
  // `coverage` says what the cameras saw.
  constructor(canvas, data, frame, coverage) {
    Object.assign(this, { canvas, frame, coverage, stale: false, drawing: false, busy: false });
    Object.assign(this, { awaited: [], refining: 0, movedAt: -Infinity });
    this.size = { width: 1, height: 1, ratio: 1 };
    const renderer = this.renderer = new THREE.WebGLRenderer({ canvas });
    renderer.setClearColor(new THREE.Color().setRGB(...data.background, THREE.SRGBColorSpace));
    this.resolution = new Resolution(renderer.getContext());
    this.near = data.near * frame.getMaxScaleOnAxis();
    this.camera = new THREE.PerspectiveCamera(50, 1, this.near, FAR);
    // As splatmake's rasterizer: 3DGS's dilation, cutoff at alpha 1/255, sorted by depth.
    this.spark = new SparkRenderer({
      renderer,
      onDirty: () => this.redraw(),
      preBlurAmount: data.antialias ? 0 : 0.3,
      blurAmount: data.antialias ? 0.3 : 0,
      maxStdDev: Math.sqrt(2 * Math.log(255)),
      minAlpha: 1 / 255,
      maxPixelRadius: Infinity,
      sortRadial: false,
      accumExtSplats: true,
      enableLod: Boolean(data.full),
      lodSplatCount: matchMedia("(pointer: coarse)").matches ? DRAWN_BY_PHONES : DRAWN,
    });
    projectAsRasterizer(this.spark);
    drawInBatches(this.spark);
    this.#modifiers = [this.#boxModifier(), this.#fadeModifier()];
    this.splats = this.#mesh({ fileBytes: bytes(document.getElementById("splats").textContent) });
    this.points = sparsePoints(data);
    this.points.visible = false;
    this.scene = new THREE.Scene().add(this.spark, this.splats, this.points);
    renderer.compile(this.spark, this.camera, this.scene); // while the Gaussians are decoded
  }

  // The modifiers of Gaussians in the world's coordinates, and in those of the page's frame.
  #modifiers;

  #mesh(options) {
    const [objectModifier, worldModifier] = this.#modifiers;
    const mesh = new SplatMesh({ extSplats: true, objectModifier, worldModifier, ...options });
    this.frame.decompose(mesh.position, mesh.quaternion, mesh.scale);
    return mesh;
  }

  // Show the Gaussians of a file instead. Of many, a tree of merged ones bounds how many are drawn.
  async replace(fileBytes, many) {
    const mesh = this.#mesh({ fileBytes, ...(many && { lod: true, nonLod: true }) });
    await mesh.initialized;
    const { splats } = this;
    mesh.visible = splats.visible;
    this.scene.remove(splats).add(mesh);
    this.splats = mesh;
    this.seen = null;
    splats.dispose();
    this.redraw();
  }

  #fadeModifier() {
    this.fade = new dyno.DynoFloat({ value: 0 });
    const { reach, centre } = this.coverage;
    const number = value => dyno.dynoConst("float", value);
    return dyno.dynoBlock(
      { gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
        const { center, opacity } = dyno.splitGsplat(gsplat).outputs;
        const distance = dyno.length(dyno.sub(center, dyno.dynoConst("vec3", centre)));
        const far = dyno.smoothstep(number(FADE[0] * reach), number(FADE[1] * reach), distance);
        const share = dyno.sub(number(1), dyno.mul(this.fade, far));
        return { gsplat: dyno.combineGsplat({ gsplat, opacity: dyno.mul(opacity, share) }) };
      });
  }

  // Far Gaussians are a background that is right only from among the cameras.
  setFade(value) {
    if (value === this.fade.value) return;
    this.fade.value = value;
    this.splats.updateVersion();
  }

  #boxModifier() {
    const corner = value => new dyno.DynoVec3({ value: new THREE.Vector3().setScalar(value) });
    this.low = corner(-Infinity);
    this.high = corner(Infinity);
    return dyno.dynoBlock(
      { gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
        const { center, opacity } = dyno.splitGsplat(gsplat).outputs;
        const inside = dyno.and(dyno.all(dyno.lessThanEqual(this.low, center)),
          dyno.all(dyno.lessThanEqual(center, this.high)));
        const shown = dyno.select(inside, opacity, dyno.dynoConst("float", 0));
        return { gsplat: dyno.combineGsplat({ gsplat, opacity: shown }) };
      });
  }

  // Hide the Gaussians outside a box, bounds included, world. Returns the number that is shown.
  crop(low = [-Infinity, -Infinity, -Infinity], high = [Infinity, Infinity, Infinity]) {
    this.low.value.fromArray(low);
    this.high.value.fromArray(high);
    this.splats.updateVersion();
    this.redraw();
    return this.#surface().count(this.isShown);
  }

  // Draw the view soon, or once there are Gaussians.
  redraw() {
    this.stale = true;
    if (!this.drawing && this.splats.isInitialized) this.#draw();
  }

  // Draw the view, which moves.
  move() {
    this.movedAt = performance.now();
    this.redraw();
  }

  // Wait until the canvas shows a frame that is drawn from now on.
  shown() {
    return new Promise(done => {
      this.awaited.push(done);
      this.redraw();
    });
  }

  // Wait until no frame is due.
  async rested() {
    while (this.drawing || this.refining) await pause();
  }

  // One frame after another: what is seen is never several frames behind, however slow the device.
  async #draw() {
    this.drawing = true;
    while (this.stale && !this.busy) {
      await new Promise(requestAnimationFrame);
      if (this.busy) break;
      this.stale = false;
      clearTimeout(this.refining);
      this.refining = 0;
      const share = this.#share(this.#moving()), awaited = this.awaited.splice(0);
      const pixels = this.#setResolution(share);
      this.renderer.render(this.scene, this.camera);
      await this.resolution.drawn(pixels, this.spark.activeSplats > 0);
      awaited.forEach(done => done());
      if (share < 1 && this.#share(0) > FINER * share)
        this.refining = setTimeout(() => this.redraw(), Math.max(this.#moving(), 0));
    }
    this.drawing = false;
  }

  // The time until the view counts as still, ms; at most 0 where it does.
  #moving() {
    return this.movedAt + STILL_AFTER - performance.now();
  }

  #share(moving) {
    const { width, height, ratio } = this.size;
    return this.resolution.share(width * height * ratio ** 2, moving > 0);
  }

  // Returns the number of pixels.
  #setResolution(share) {
    const { renderer, canvas, size: { width, height, ratio } } = this;
    const [x, y] = [width, height].map(side => Math.floor(side * ratio * share));
    if (canvas.width !== x || canvas.height !== y)
      renderer.setDrawingBufferSize(width, height, ratio * share);
    return x * y;
  }

  resize(width, height, fov) {
    this.size = { width, height, ratio: Math.min(devicePixelRatio, 2) };
    this.camera.aspect = width / height;
    this.camera.fov = fov;
    this.camera.updateProjectionMatrix();
    this.redraw();
  }

  // Once the Gaussians are there.
  #surface() {
    return this.seen ??= new Surface(this.splats);
  }

  // Whether a Gaussian with this mean, world, is in the box.
  isShown = (x, y, z) => {
    const { low: { value: low }, high: { value: high } } = this;
    return low.x <= x && x <= high.x && low.y <= y && y <= high.y && low.z <= z && z <= high.z;
  };

  // The point of the surface at a position on the canvas, in normalised device coordinates: at the
  // median distance along nine rays around it, `spread` apart. null if less than half of them meet
  // the surface, or if it is farther than `reach` from the scene's centre.
  surface(x, y, spread, reach = Infinity) {
    const { camera, coverage, near } = this;
    this.splats.updateMatrixWorld();
    const steps = [[0, 0], [-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 1], [1, -1], [1, 0], [1, 1]];
    const rays = steps.map(([i, j]) => {
      const caster = new THREE.Raycaster();
      caster.setFromCamera(new THREE.Vector2(x + i * spread, y + j * spread), camera);
      return caster.ray;
    });
    const pixel = 2 * Math.tan(THREE.MathUtils.degToRad(camera.fov / 2)) / this.canvas.clientHeight;
    const depths = this.#surface()
      .depths(rays, near, pixel, this.isShown).filter(depth => depth !== null);
    if (depths.length < 5) return null;
    depths.sort((a, b) => a - b);
    const point = rays[0].at(depths[depths.length >> 1], new THREE.Vector3());
    return point.distanceTo(coverage.centre) < reach ? point : null;
  }

  // Wait until the splats are coloured and sorted for this camera.
  async settled(camera = this.camera) {
    const { spark, scene } = this;
    const idle = async () => {
      while (spark.sorting || spark.sortDirty) await pause();
    };
    await idle();
    await spark.update({ scene, camera });
    await idle();
  }

  // Render the splats alone; returns the data URL of a PNG. The camera is a pinhole in world
  // coordinates with the fields of data.cameras.
  async picture({ width, height, fx, fy, cx, cy, world_to_camera }) {
    const { near, renderer, scene } = this;
    const camera = new THREE.PerspectiveCamera();
    Object.assign(camera, { near, far: FAR });
    const { position, quaternion } = poseInPage(world_to_camera, this.frame);
    camera.position.copy(position);
    camera.quaternion.copy(quaternion);
    camera.updateMatrixWorld();
    camera.projectionMatrix.set(
      2 * fx / width, 0, 1 - 2 * cx / width, 0,
      0, 2 * fy / height, 2 * cy / height - 1, 0,
      0, 0, (near + FAR) / (near - FAR), 2 * near * FAR / (near - FAR),
      0, 0, -1, 0);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    const others = scene.children.filter(object => object !== this.spark && object !== this.splats);
    const shown = others.map(object => object.visible), { visible } = this.splats;
    this.busy = true;
    try {
      others.forEach(object => { object.visible = false; });
      this.splats.visible = true;
      renderer.setPixelRatio(1);
      renderer.setSize(width, height, false);
      this.setFade(0);
      await this.settled(camera);
      renderer.render(scene, camera);
      return this.canvas.toDataURL("image/png");
    } finally {
      this.busy = false;
      others.forEach((object, i) => { object.visible = shown[i]; });
      this.splats.visible = visible;
    }
  }
}

function sparsePoints(data) {
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
