// The map, in 3D where the browser can and from above where it cannot or where one likes it: one face to the panels.

import { $, address, notice } from "./page.js";
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
    this.show(address.read().view === "2d" ? "flat" : "deep");
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
    address.write({ view: deep ? null : this.cloud ? "2d" : null });
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
    this.labels.set(this.pending ? [this.pending] : this.changes);
    this.placeLabels();
  }

  setRaster(hash, points) {
    this.flat.setRaster(hash, points);
  }

  // {colour, line}: lines of [x, y, z] or, on the ground, of [x, y], map metres, in the place of those of this layer.
  setPaths(layer, lines) {
    this.layers = { ...this.layers, [layer]: lines };
    const paths = Object.values(this.layers).flat();
    this.flat.setPaths(paths);
    const risen = (line) => line.map(([x, y, z]) => [x, y, z ?? this.groundAt([x, y, x, y])]);
    this.cloud?.setLines(paths.map(({ colour, line }) => ({ colour, line: risen(line) })));
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

  // Of the two states of the map that are known: "before", "after", or both as "swipe".
  compare(name) {
    this.show("deep");
    $("compare").value = name;
    this.tools?.compare(name);
  }

  zoom(factor) {
    this.mode === "deep" ? this.cloud.orbit.zoom(factor) : this.flat.zoom(factor);
  }

  turned() {
    if (this.mode !== "deep" || !this.cloud) return;
    this.stream?.moved();
    this.placeLabels();
    this.tools?.place(this.cloud);
    if (this.placed) address.write({ eye: this.cloud.orbit.state.map((v) => Number(v.toFixed(2))).join(",") });
  }

  placeLabels() {
    if (this.mode === "deep" && this.cloud) this.labels.place(this.cloud, this.groundAt.bind(this));
  }

  picked(px) {
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
export function inside(change, [x, y]) {
  let odd = false;
  for (const polygon of change.polygons)
    for (const ring of polygon)
      for (let i = 1; i < ring.length; i++) {
        const [[x0, y0], [x1, y1]] = [ring[i - 1], ring[i]];
        if (y0 > y !== y1 > y && x < x0 + ((y - y0) / (y1 - y0)) * (x1 - x0)) odd = !odd;
      }
  return odd;
}

const REACH_PX = 8;

// The nearest visible point to the eye within a few pixels of one: [x, y, z] in map metres, or null.
export function pointAt(cloud, px) {
  const { from, way } = cloud.ray(px), radius = REACH_PX / (cloud.shared.pixels.value / cloud.shared.ratio.value);
  let best = null, nearest = Infinity;
  for (const part of cloud.parts) {
    if (!part.points.visible) continue;
    const [ox, oy, oz] = [part.corner[0] - from[0], part.corner[1] - from[1], part.z0 - from[2]];
    const step = 76.8 / 65535, p = part.packed, [low, high] = cloud.shared.slice.value.toArray();
    for (let i = 0; i < p.length; i += 4) {
      const x = ox + p[i] * step, y = oy + p[i + 1] * step, z = oz + p[i + 2] * part.zStep;
      const along = x * way[0] + y * way[1] + z * way[2];
      if (along <= 0 || along >= nearest) continue;
      const off = x * x + y * y + z * z - along * along;
      if (off > (radius * along) ** 2) continue;
      const above = p[i + 3] / 100 - 10;
      if (above < low || above > high) continue;
      nearest = along;
      best = [from[0] + x, from[1] + y, from[2] + z];
    }
  }
  return best;
}

// Where a ray meets the level z, for clicks that meet no point.
export function levelAt(cloud, px, z) {
  const { from, way } = cloud.ray(px), t = (z - from[2]) / way[2];
  return t > 0 && t < 1e5 ? [from[0] + t * way[0], from[1] + t * way[1], z] : null;
}

export const distance = (a, b) => Math.hypot(...a.map((v, i) => v - b[i]));

// Signs over the large changes: word and sign tell what happened, not colour alone.
const MOST = 24;

class Labels {
  constructor(home, onChosen) {
    Object.assign(this, { home, onChosen, signs: [] });
  }

  set(changes) {
    const large = changes.filter((c) => c.size === "large" || c.pending).slice(0, MOST);
    this.signs = large.map((change) => {
      const sign = document.createElement("button");
      sign.type = "button";
      sign.tabIndex = -1;  // the list beside it holds the same, in order, for the keyboard
      sign.className = `sign ${change.kind}`;
      sign.textContent = `${change.pending ? "pending: " : ""}${change.kind === "built" ? "+ built" : "\u00d7 demolished"}${change.height ? ` ${change.height.toFixed(0)} m` : ""}`;
      sign.onclick = () => this.onChosen(change.id);
      return { change, sign };
    });
    this.home.replaceChildren(...this.signs.map((s) => s.sign));
  }

  select(id) {
    for (const { change, sign } of this.signs) sign.classList.toggle("chosen", change.id === id);
  }

  place(cloud, groundAt) {
    const taken = [];
    const [w, h] = [cloud.canvas.clientWidth, cloud.canvas.clientHeight];
    for (const { change, sign } of this.signs) {
      const [x0, y0, x1, y1] = change.box;
      const at = cloud.project([(x0 + x1) / 2, (y0 + y1) / 2, groundAt(change.box) + (change.height ?? 4) + 1.5]);
      const out = !at || at[0] < 0 || at[1] < 0 || at[0] > w || at[1] > h;
      const crowded = !out && taken.some((o) => Math.abs(o[0] - at[0]) < 110 && Math.abs(o[1] - at[1]) < 22);
      sign.hidden = out || crowded;
      if (sign.hidden) continue;
      taken.push(at);
      sign.style.transform = `translate(${at[0]}px, ${at[1]}px) translate(-50%, -100%)`;
    }
  }
}
