// The cloud in 3D: parts of tiles on the graphics card, drawn when something changed. Knows nothing of the server.

import {
  BufferAttribute, BufferGeometry, Color, ColorManagement, DataTexture, DepthTexture, Frustum, GLSL3, LineBasicMaterial,
  LineSegments, Matrix4, Mesh, NearestFilter,
  PerspectiveCamera, PlaneGeometry, Points, RawShaderMaterial, Scene, Sphere, UnsignedByteType, Vector2, Vector3,
  WebGLRenderTarget, WebGLRenderer,
} from "./vendor/three.module.min.js";
import { Orbit } from "./orbit.js";
import { COLOUR, MARK, POINT_FRAGMENT, POINT_VERTEX, QUAD_FRAGMENT, QUAD_VERTEX, RAMPS } from "./shaders.js";

export const TILE = 76.8;

// Where the ground of a cloud lies, metres: by what most of its points say, for some may be reflections far below it.
// Some thousand of them tell.
export function groundOf({ z0, zStep, packed }) {
  const n = packed.length / 4, apart = Math.ceil(n / 1000);
  const said = Float64Array.from({ length: n && Math.ceil(n / apart) }, (_, k) => {
    const i = 4 * k * apart;
    return z0 + packed[i + 2] * zStep - (packed[i + 3] - 1000) / 100;
  });
  return said.sort()[said.length >> 1] ?? z0;
}
const NEAR_SHARE = 0.01, REST = 2, REST_MS = [300, 1500];
ColorManagement.enabled = false;  // the page's colours, as they are

export class Cloud {
  constructor(canvas, { onPick = () => {}, onMove = () => {}, onDrawn = () => {} } = {}) {
    Object.assign(this, { canvas, onPick, onMove, onDrawn });
    this.renderer = new WebGLRenderer({ canvas, antialias: false, alpha: false, powerPreference: "high-performance", preserveDrawingBuffer: true });
    this.scene = new Scene();
    this.scene.matrixWorldAutoUpdate = false;
    this.camera = new PerspectiveCamera(45.8, 1, 1, 1000);
    this.camera.up.set(0, 0, 1);
    this.origin = [0, 0, 0];
    this.parts = new Set();
    this.sides = "new";  // which of two states of the map: "old", "new", or a number: old left of that share
    this.lit = true;
    this.expecting = false;  // whether more is on its way
    this.rested = 0;
    const blank = new DataTexture(new Uint8Array(4), 1, 1);
    blank.needsUpdate = true;
    this.blank = blank;
    this.shared = {
      pixels: { value: 500 }, coarse: { value: 1 }, ratio: { value: 1 }, slice: { value: new Vector2(-1e4, 1e4) },
      colour: { value: COLOUR.height }, ramp: { value: blank }, ground: { value: new Color() }, plain: { value: new Color() },
      removed: { value: new Color() }, added: { value: new Color() },
    };
    this.prepareLight();
    this.readColours();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.readColours());
    this.orbit = new Orbit(canvas, () => this.moved(), (px) => this.onPick(px));
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  readColours() {
    const style = getComputedStyle(document.documentElement);
    const set = (colour, name) => colour.setStyle(style.getPropertyValue(name).trim() || "#888888", "");
    set(this.shared.ground.value, "--cloud-ground");
    set(this.shared.plain.value, "--cloud-plain");
    set(this.shared.removed.value, "--demolished");
    set(this.shared.added.value, "--built");
    const back = new Color();
    set(back, "--cloud-back");
    this.renderer.setClearColor(back, 1);
    this.shared.ramp.value = ramp(RAMPS[matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"]);
    this.draw();
  }

  // One part of a tile whose corner is (x, y) in map metres. `side`: "old", "new" or "both"; returns what remove() takes.
  add({ x, y, z0, zStep, packed, bright = null, spacing, side = "both", mark = MARK.none, evidence = null, tile = null, level = 0 }) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("place", new BufferAttribute(packed, 4));
    if (bright) geometry.setAttribute("bright", new BufferAttribute(bright, 1, true));
    geometry.setDrawRange(0, packed.length / 4);
    geometry.boundingSphere = new Sphere(new Vector3(38.4, 38.4, z0), 60);
    const own = { z0: { value: z0 }, zStep: { value: zStep }, spacing: { value: spacing }, mark: { value: mark }, evidence: { value: evidence ?? this.blank } };
    const material = new RawShaderMaterial({ glslVersion: GLSL3, vertexShader: POINT_VERTEX, fragmentShader: POINT_FRAGMENT, uniforms: { ...this.shared, ...own } });
    const points = new Points(geometry, material);
    points.frustumCulled = false;
    points.position.set(x - this.origin[0], y - this.origin[1], -this.origin[2]);
    points.updateMatrix();
    points.updateMatrixWorld(true);
    const part = { points, side, mark, tile, level, packed, z0, zStep, corner: [x, y], count: packed.length / 4, wanted: true };
    this.parts.add(part);
    this.scene.add(points);
    this.draw();
    return part;
  }

  remove(part) {
    this.parts.delete(part);
    this.scene.remove(part.points);
    part.points.geometry.dispose();
    part.points.material.dispose();
  }

  // Lines of [x, y, z], map metres, seen through everything; they take the place of those before.
  setLines(lines) {  // {colour: "path" or "next", line: of [x, y, z]}
    if (this.lines) {
      this.scene.remove(this.lines);
      this.lines.geometry.dispose();
      this.lines.material.dispose();
      this.lines = null;
    }
    const local = ([x, y, z]) => [x - this.origin[0], y - this.origin[1], z - this.origin[2] + 0.3];
    const ends = lines.flatMap(({ line }) => line.slice(1).flatMap((at, i) => [...local(line[i]), ...local(at)]));
    if (ends.length) {
      const style = getComputedStyle(document.documentElement), made = new Color();
      const of = (name) => made.setStyle(style.getPropertyValue(`--${name}`).trim(), "").toArray();
      const colours = lines.flatMap(({ colour, line }) => Array(2 * (line.length - 1)).fill(of(colour)).flat());
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(new Float32Array(ends), 3));
      geometry.setAttribute("color", new BufferAttribute(new Float32Array(colours), 3));
      this.lines = new LineSegments(geometry, new LineBasicMaterial({ vertexColors: true, depthTest: false, depthWrite: false }));
      this.lines.frustumCulled = false;
      this.lines.renderOrder = 1;
      this.scene.add(this.lines);
    }
    this.draw();
  }

  texture(bytes) {  // (256, 256, 4) evidence of one tile
    const made = new DataTexture(bytes, 256, 256);
    made.magFilter = made.minFilter = NearestFilter;
    made.needsUpdate = true;
    return made;
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 2), w = this.canvas.clientWidth || 1, h = this.canvas.clientHeight || 1;
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(w, h, false);
    this.target.setSize(Math.round(w * ratio), Math.round(h * ratio));
    this.quad.material.uniforms.pixel.value.set(1.4 / w, 1.4 / h);
    this.camera.aspect = w / h;
    this.shared.ratio.value = ratio;
    this.shared.pixels.value = (h * ratio) / (2 * Math.tan(0.4));
    this.moved();
  }

  moved() {
    const { camera, orbit } = this;
    if (!orbit) return;
    const local = (p) => p.map((v, i) => v - this.origin[i]);
    camera.position.set(...local(orbit.eye));
    camera.lookAt(...local(orbit.target));
    camera.near = Math.max(orbit.distance * NEAR_SHARE, 0.1);
    camera.far = orbit.distance * 12 + 600;
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
    this.onMove(this);
    this.now();
  }

  frustum() {
    return new Frustum().setFromProjectionMatrix(new Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse));
  }

  // Map metres -> pixels of the canvas, or null behind the eye.
  project([x, y, z]) {
    const at = new Vector3(x - this.origin[0], y - this.origin[1], z - this.origin[2]).project(this.camera);
    if (at.z > 1) return null;
    return [(0.5 + 0.5 * at.x) * this.canvas.clientWidth, (0.5 - 0.5 * at.y) * this.canvas.clientHeight];
  }

  // {from, way}: the ray through a pixel, in map metres.
  ray([px, py]) {
    const at = new Vector3((2 * px) / this.canvas.clientWidth - 1, 1 - (2 * py) / this.canvas.clientHeight, 0.5).unproject(this.camera);
    const way = at.sub(this.camera.position).normalize().toArray();
    return { from: this.camera.position.toArray().map((v, i) => v + this.origin[i]), way };
  }

  // With the next frame. While more is on its way and the eye rests, frames leave the processor to what comes: where
  // the processor draws, each takes as long as several answers.
  draw() {
    if (this.pending) return;
    const wait = this.expecting ? this.rested - performance.now() : 0;
    if (wait > 0) return void (this.later ??= setTimeout(() => this.now(), wait));
    this.now();
  }

  now() {
    clearTimeout(this.later);
    this.later = null;
    this.pending ??= requestAnimationFrame(() => {
      this.pending = null;
      if (this.canvas.hidden) return;
      const begun = performance.now();
      requestAnimationFrame(() => {
        const now = performance.now();
        this.rested = now + Math.min(Math.max(REST * (now - begun), REST_MS[0]), REST_MS[1]);
      });
      this.paint();
    });
  }

  paint() {
    const { renderer: r } = this, w = this.canvas.clientWidth, h = this.canvas.clientHeight;
    r.setRenderTarget(this.lit ? this.target : null);
    r.setScissorTest(false);
    r.clear();
    const sides = typeof this.sides === "number" ? ["old", "new"] : [this.sides];
    r.autoClear = false;
    for (const [i, side] of sides.entries()) {
      for (const part of this.parts) part.points.visible = part.wanted && (part.side === "both" || part.side === side);
      if (sides.length > 1) {
        const cut = Math.round(w * this.sides), where = i ? [cut, 0, w - cut, h] : [0, 0, cut, h];
        if (this.lit) this.target.scissor.set(...where.map((v) => v * this.shared.ratio.value));
        else r.setScissor(...where);
        this.lit ? (this.target.scissorTest = true) : r.setScissorTest(true);
        r.setRenderTarget(this.lit ? this.target : null);
      }
      r.render(this.scene, this.camera);
    }
    this.target.scissorTest = false;
    r.setScissorTest(false);
    if (this.lit) {
      r.setRenderTarget(null);
      this.quad.material.uniforms.planes.value.set(this.camera.near, this.camera.far);
      r.clear();
      r.render(this.quadScene, this.camera);
    }
    this.onDrawn(this);
  }

  prepareLight() {
    this.target = new WebGLRenderTarget(2, 2, { minFilter: NearestFilter, magFilter: NearestFilter, type: UnsignedByteType });
    this.target.depthTexture = new DepthTexture(2, 2);
    const uniforms = {
      image: { value: this.target.texture }, depth: { value: this.target.depthTexture }, pixel: { value: new Vector2() },
      planes: { value: new Vector2(1, 100) }, strength: { value: 2.6 },
    };
    const material = new RawShaderMaterial({ glslVersion: GLSL3, vertexShader: QUAD_VERTEX, fragmentShader: QUAD_FRAGMENT, uniforms, depthTest: false, depthWrite: false });
    this.quad = new Mesh(new PlaneGeometry(2, 2), material);
    this.quad.frustumCulled = false;
    this.quadScene = new Scene();
    this.quadScene.add(this.quad);
  }
}

function ramp(stops) {
  const colours = stops.map((s) => [1, 3, 5].map((i) => parseInt(s.slice(i, i + 2), 16)));
  const texels = new Uint8Array(256 * 4);
  for (let i = 0; i < 256; i++) {
    const at = (i / 255) * (colours.length - 1), k = Math.min(Math.floor(at), colours.length - 2);
    for (let c = 0; c < 3; c++) texels[4 * i + c] = colours[k][c] + (at - k) * (colours[k + 1][c] - colours[k][c]);
    texels[4 * i + 3] = 255;
  }
  const made = new DataTexture(texels, 256, 1);
  made.needsUpdate = true;
  return made;
}
