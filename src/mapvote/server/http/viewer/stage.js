// The map, in 3D where the browser can and from above where it cannot or where one likes it: one face to the panels.

import { $, notice } from "./dom.js";
import { Labels } from "./labels.js";
import * as link from "./link.js";
import { View } from "./view.js";

export class Stage {
  constructor(api, { onPick, onMove }) {
    Object.assign(this, { api, onPick });
    this.flat = new View($("map"), { onPick, onMove, wantTile: (hash) => this.wantTile(hash) });
    this.labels = new Labels($("labels"), (id) => onPick(null, { id }));
    this.changes = [];
    this.tiles = [];
    this.mode = "flat";
  }

  // Three dimensions, if this browser has them; the page goes on without.
  async begin(overview) {
    const [{ Cloud }, { Stream }] = await Promise.all([import("./cloud.js"), import("./stream.js")]);
    this.cloud = new Cloud($("cloud"), { onPick: (px) => this.picked(px), onMove: () => this.turned() });
    this.stream = new Stream(this.cloud, this.api, { onLoaded: (s) => this.loaded(s), onError: (error) => notice(error.message) });
    $("to-3d").hidden = false;
    $("how").open = !matchMedia("(max-width: 760px)").matches;  // on a phone the cloud comes first
    this.show(link.read().view === "2d" ? "flat" : "deep");
    const buffer = await overview;
    return buffer;
  }

  // Whether this browser can; if not, the page says so.
  possible() {
    if (this.cloud) return true;
    const probe = document.createElement("canvas").getContext("webgl2");
    probe?.getExtension("WEBGL_lose_context")?.loseContext();
    if (!probe) this.without("This browser shows no 3D (WebGL 2 is off): the map is seen from above.");
    return Boolean(probe);
  }

  without(text) {
    $("busy").hidden = true;
    $("deep-controls").hidden = true;
    $("hint-3d").textContent = text;
    $("hint-3d").hidden = false;
    return null;
  }

  show(mode) {
    if (mode === "deep" && !this.cloud) return;
    this.mode = mode;
    const deep = mode === "deep";
    $("map").hidden = deep;
    $("cloud").hidden = $("deep-controls").hidden = !deep;
    $("labels").hidden = !deep;
    $("to-3d").textContent = deep ? "2D" : "3D";
    $("to-3d").title = deep ? "From above (2)" : "In 3D (3)";
    document.body.classList.toggle("deep", deep);
    link.write({ view: deep ? null : this.cloud ? "2d" : null });
    if (deep) {
      this.cloud.resize();
      this.stream?.plan();
    } else this.flat.resize();
  }

  wantTile(hash) {
    this.onWanted?.(hash);
  }

  setTiles(tiles) {
    this.tiles = tiles;
    this.flat.setTiles(tiles);
  }

  setChanges(changes) {
    this.changes = changes;
    this.mark();
  }

  // A change that waits at the desk and is looked at: marked as those that were made. Null: none.
  setPending(change) {
    this.pending = change && { ...change, pending: true };
    this.mark();
  }

  mark() {
    const all = this.pending ? [this.pending, ...this.changes] : this.changes;
    this.flat.setChanges(all);
    this.labels.set(all);
    this.placeLabels();
  }

  setRaster(hash, points) {
    this.flat.setRaster(hash, points);
  }

  // Lines of [x, y, z], map metres.
  setPaths(lines) {
    this.flat.setPaths(lines);
    this.cloud?.setLines(lines);
  }

  select(id, cell = null) {
    this.flat.select(id, cell);
    this.labels.select(id);
    this.placeLabels();
  }

  fit(box, margin = 0.1, flight = {}) {
    this.flat.fit(box, margin);
    if (!this.cloud) return;
    const height = flight.height ?? 0, wide = 1 + 2.2 * margin;
    this.cloud.orbit.flyTo(box, this.groundAt(box) + height / 3, { margin: wide, height, ...flight });
  }

  // About where the ground lies there, by the tile's coarse picture.
  groundAt(box) {
    const [x, y] = [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2];
    const inside = (t) => x >= t.x && x < t.x + 76.8 && y >= t.y && y < t.y + 76.8 && t.levels.length;
    const near = this.stream?.tiles.find(inside) ?? this.stream?.tiles.find((t) => t.levels.length);
    return near?.ground ?? 0;
  }

  zoom(factor) {
    this.mode === "deep" ? this.cloud.orbit.zoom(factor) : this.flat.zoom(factor);
  }

  turned() {
    if (this.mode !== "deep" || !this.cloud) return;
    this.stream?.moved();
    this.placeLabels();
    this.tools?.place(this.cloud);
    if (this.placed) link.write({ eye: this.cloud.orbit.state.map((v) => Number(v.toFixed(2))).join(",") });
  }

  placeLabels() {
    if (this.mode === "deep" && this.cloud) this.labels.place(this.cloud, this.groundAt.bind(this));
  }

  async picked(px) {
    const { levelAt, pointAt } = await import("./pick.js");
    const at = pointAt(this.cloud, px) ?? levelAt(this.cloud, px, this.cloud.orbit.target[2]);
    if (!at) return;
    if (this.tools?.take(at)) return;
    this.onPick([at[0], at[1]], this.changes.find((c) => inside(c, at)) ?? null);
  }

  loaded(stream) {
    if (!stream.tiles.length) return;
    $("busy").hidden = !stream.busy;
  }
}

// Whether a place lies in one of a change's polygons: a ray to the east crosses its rings an odd number of times.
function inside(change, [x, y]) {
  let odd = false;
  for (const polygon of change.polygons)
    for (const ring of polygon)
      for (let i = 1; i < ring.length; i++) {
        const [[x0, y0], [x1, y1]] = [ring[i - 1], ring[i]];
        if (y0 > y !== y1 > y && x < x0 + ((y - y0) / (y1 - y0)) * (x1 - x0)) odd = !odd;
      }
  return odd;
}
