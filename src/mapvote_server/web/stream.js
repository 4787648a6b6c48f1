// Which parts of which tiles: what is in view, coarse first, as many points as the frame rate allows.

import { Box3, Vector3 } from "./vendor/three.module.min.js";
import { groundOf, TILE } from "./cloud.js";
import { MARK } from "./shaders.js";

export const SPACING = [4.8, 2.4, 1.2, 0.6, 0.3, 0.15];  // metres between the points of each level
const HEAD = 24, AT_ONCE = 6, ENOUGH_PIXELS = 1.1, MOST_LOADED = 14e6, FRAME_MS = [45, 75], LEAST = 30_000, MOST = 4e6;
const MOST_TOLD = 256;  // tiles in view of which votes are shown: 256 kB each
const FIRST = 40_000;  // points of the first picture, so that it comes at once even where the processor draws

// {z0, zStep, packed} of one cloud of an answer, and where the next one begins.
export function unpack(buffer, offset = 0) {
  const view = new DataView(buffer, offset), n = view.getUint32(4, true);
  if (view.getUint32(0, true) !== 0x3143564d) throw new Error("this is no cloud");
  return { z0: view.getFloat32(8, true), zStep: view.getFloat32(12, true), packed: new Uint16Array(buffer, offset + 16, 4 * n), end: offset + 16 + 8 * n };
}

export class Stream {
  constructor(cloud, api, { onLoaded = () => {}, onError = () => {} } = {}) {
    Object.assign(this, { cloud, api, onLoaded, onError });
    this.tiles = [];
    this.budget = 600_000;
    this.loading = 0;
    this.last = 0;
    cloud.lit = false;  // until the first picture is there
    cloud.onDrawn = () => this.drawn();
  }

  // The tiles of the newer version (and of the older one where it differs), placed round the map's middle.
  setTiles(lattice, newer, older) {
    const known = new Map(this.tiles.map((t) => [t.id, t]));
    const made = [];
    const want = (name, hashes, side) => {
      const id = `${name} ${hashes.points} ${side}`, [row, col] = name.split(",").map(Number);
      const fresh = { id, name, hashes, side, x: lattice.x0 + col * TILE, y: lattice.y0 + row * TILE, levels: [], low: 0, ground: 0, high: 12, evidence: null };
      made.push(known.get(id) ?? fresh);
      known.delete(id);
    };
    for (const [name, hashes] of Object.entries(newer)) want(name, hashes, !older || older[name]?.points === hashes.points ? "both" : "new");
    for (const [name, hashes] of Object.entries(older ?? {})) if (newer[name]?.points !== hashes.points) want(name, hashes, "old");
    for (const gone of known.values()) this.drop(gone);
    this.tiles = made;
  }

  place(origin) {
    this.cloud.origin = origin;
  }

  // The first picture: every tile, coarse.
  overview(buffer, side = "new") {
    const view = new DataView(buffer), n = view.getUint32(4, true);
    const counts = Array.from({ length: n }, (_, i) => view.getUint32(8 + HEAD * i + 12, true));
    let at = 8 + HEAD * n, lit = at + 8 * counts.reduce((sum, count) => sum + count, 0);
    this.bright = lit < buffer.byteLength;
    for (let i = 0; i < n; i++) {
      const read = 8 + HEAD * i, count = counts[i], name = `${view.getInt32(read, true)},${view.getInt32(read + 4, true)}`;
      const whole = view.getInt32(read + 8, true);
      const tile = this.tiles.find((t) => t.name === name && (t.side === "both" || t.side === side));
      const z0 = view.getFloat32(read + 16, true), zStep = view.getFloat32(read + 20, true);
      const packed = new Uint16Array(buffer.slice(at, at + 8 * count));
      const bright = this.bright ? new Uint8Array(buffer.slice(lit, lit + count)) : null;
      at += 8 * count;
      lit += count;
      if (tile) this.take(tile, Math.max(whole, 0), { z0, zStep, packed, bright }, whole < 0 ? 0 : whole + 1, SPACING[Math.max(whole, 0)]);
    }
  }

  take(tile, level, cloud, next, spacing) {
    const { z0, zStep, packed, bright } = cloud;
    const part = this.cloud.add({ ...tile, z0, zStep, packed, bright, spacing, tile, level, evidence: tile.evidence });
    if (!tile.levels.length) {
      Object.assign(tile, { low: z0, ground: groundOf(cloud) });
      let top = 0;
      for (let i = 2; i < packed.length; i += 4) top = Math.max(top, packed[i]);
      tile.high = z0 + top * zStep;
    }
    tile.levels.push(part);
    tile.next = next;
    if (next === 0) tile.partial = part;
    return part;
  }

  drop(tile) {
    for (const part of tile.levels) this.cloud.remove(part);
    Object.assign(tile, { levels: [], next: 0, partial: null });
  }

  // What to draw with this budget, and what to ask for next.
  plan(budget = this.budget) {
    const { cloud } = this, frustum = cloud.frustum(), eye = cloud.camera.position, pixels = cloud.shared.pixels.value / cloud.shared.ratio.value;
    const wanted = [];
    const box = new Box3(), corner = new Vector3();
    for (const tile of this.tiles) {
      const [x, y, z] = [tile.x - cloud.origin[0], tile.y - cloud.origin[1], -cloud.origin[2]];
      box.min.set(x, y, z + tile.low);
      box.max.set(x + TILE, y + TILE, z + tile.high);
      tile.seen = frustum.intersectsBox(box);
      tile.away = Infinity;
      for (const part of tile.levels) part.share = 0;
      if (!tile.seen || (tile.side === "old" && cloud.sides === "new") || (tile.side === "new" && cloud.sides === "old")) continue;
      const distance = (tile.away = Math.max(box.distanceToPoint(corner.copy(eye)), 2));
      for (const part of tile.levels) wanted.push({ px: (SPACING[part.level] * pixels) / distance, part, tile });
      if ((tile.next ?? 0) < SPACING.length) wanted.push({ px: (SPACING[tile.next ?? 0] * pixels) / distance, part: null, tile });
    }
    wanted.sort((a, b) => b.px - a.px);
    const all = wanted.reduce((sum, { part }) => sum + (part?.count ?? 0), 0);
    const share = this.marked ? 1 : Math.min(1, FIRST / all);
    cloud.shared.coarse.value = Math.sqrt(1 / share);
    let left = budget;
    this.queue = [];
    for (const { px, part, tile } of wanted) {
      if (part) {
        if (left <= 0) continue;
        part.share = Math.ceil(share * Math.min(part.count, left));
        left -= part.count;
      } else if (px > ENOUGH_PIXELS && left > 0) this.queue.push(tile);
    }
    this.shown = budget - Math.max(left, 0);
    if (this.tiles.map((tile) => this.show(tile)).some(Boolean)) cloud.draw();
    this.fetch();
    if (this.asked) this.tell().then(() => this.forget(), this.onError);
  }

  // Draws of a tile what was planned; whether that is another picture than before.
  show(tile) {
    const said = tile.levels.map((part) => `${part.level} ${part.share}`).join();
    if (said === tile.said) return false;
    tile.said = said;
    for (const part of tile.levels) {
      part.wanted = part.share > 0;
      part.points.geometry.setDrawRange(0, part.share);
    }
    this.space(tile);
    return true;
  }

  // Points grow where finer levels are missing, so that walls stay closed.
  space(tile) {
    const drawn = tile.levels.filter((p) => p.wanted);
    const spacing = Math.max(SPACING[Math.max(...drawn.map((p) => p.level), 0)] ?? 1, 0.16);
    for (const part of drawn) part.points.material.uniforms.spacing.value = spacing;
  }

  fetch() {
    while (this.loading < AT_ONCE && this.queue.length) {
      const tile = this.queue.shift();
      if (tile.loading) continue;
      tile.loading = true;
      this.loading++;
      this.load(tile).catch((error) => ((tile.next = SPACING.length), this.onError(error))).finally(() => {
        tile.loading = false;
        this.loading--;
        this.told();
        this.soon();
      });
    }
    this.told();
  }

  get busy() {
    return this.loading > 0 || this.queue?.length > 0 || !this.compared;
  }

  told() {
    const { cloud } = this, done = cloud.expecting && !this.busy;
    cloud.expecting = this.busy;
    if (done) cloud.draw();
    this.onLoaded(this);
  }

  async load(tile) {
    const level = tile.next ?? 0;
    const buffer = await this.api.cloudPart(tile.hashes, level);
    if (!this.tiles.includes(tile)) return;
    if (tile.partial) {
      this.cloud.remove(tile.partial);
      tile.levels = tile.levels.filter((p) => p !== tile.partial);
      tile.partial = null;
    }
    const cloud = unpack(buffer);
    if (cloud.end < buffer.byteLength) cloud.bright = new Uint8Array(buffer, cloud.end);
    this.take(tile, level, cloud, level + 1, SPACING[level]);
    this.tidy();
  }

  tidy() {  // what is out of view goes first
    let total = 0;
    for (const tile of this.tiles) for (const part of tile.levels) total += part.count;
    for (const tile of this.tiles) {
      if (total < MOST_LOADED) return;
      if (tile.seen) continue;
      for (const part of tile.levels) total -= part.count;
      this.drop(tile);
    }
  }

  soon() {
    this.waiting ??= setTimeout(() => ((this.waiting = null), this.plan(this.still ? 8 * this.budget : this.budget)), 30);
  }

  // The eye moved: draw what the budget allows, and once it rests, more.
  moved() {
    if (this.still !== false) this.frames = 0;
    this.still = false;
    this.plan();
    clearTimeout(this.resting);
    this.resting = setTimeout(() => this.rest(), 250);
  }

  rest() {
    clearTimeout(this.resting);
    this.still = true;
    this.light(Boolean(this.marked));
    this.plan(8 * this.budget);
  }

  light(lit) {
    if (lit !== this.cloud.lit) this.cloud.draw();
    this.cloud.lit = lit;
  }

  // Between two frames of one movement: too long a time takes points away, at once if it is far too long.
  adapt() {
    const now = performance.now(), gap = now - this.last;
    this.last = now;
    if (this.still !== false || this.frames++ < 1) return;
    if (gap > FRAME_MS[1]) this.budget = Math.max(LEAST, this.budget * Math.max(0.5, FRAME_MS[0] / gap));
    else if (gap < FRAME_MS[0] && this.shown >= 0.9 * this.budget) this.budget = Math.min(MOST, this.budget * 1.1);
    this.cloud.lit = this.budget > LEAST;  // where the fewest points are still too many, the light goes too
  }

  drawn() {
    this.adapt();
    const drawn = (name, then = () => {}) => requestAnimationFrame(() => (performance.mark(name), then()));  // it is on screen once the next frame begins
    if (!this.marked && this.tiles.some((t) => t.levels.length)) {
      this.marked = true;
      drawn("first-points", () => (this.still ? this.rest() : this.soon()));
    } else if (this.marked && this.still && !this.busy && !this.complete) {
      this.complete = true;
      drawn("all-in-view");
    }
  }

  // Whether points are coloured by what ballots say (of one vehicle, if it is named): asked for the nearest tiles in
  // view, and for others as they come into view.
  async evidence(colours, vehicle) {
    this.asked = colours ? { vehicle } : null;
    if (!colours) for (const tile of this.tiles) this.wear(tile, null);
    await this.tell();
    this.cloud.draw();
  }

  async tell() {
    while (this.untold()) await this.askAtOnce();
  }

  askAtOnce() {
    return (this.telling ??= Promise.all(Array.from({ length: AT_ONCE }, () => this.askOn())).finally(() => (this.telling = null)));
  }

  async askOn() {
    for (let tile; (tile = this.untold()); ) {
      const { asked } = this;
      tile.told = asked;
      const bytes = await this.api.evidence(tile.name, asked.vehicle);
      if (this.asked === asked) this.wear(tile, this.cloud.texture(new Uint8Array(bytes)));
    }
  }

  // The next tile to ask for: of the nearest in view the first whose votes are not known.
  untold() {
    const { asked } = this, near = (a, b) => a.away - b.away;
    return asked && this.tiles.filter((tile) => tile.seen).sort(near).slice(0, MOST_TOLD).find((tile) => tile.told !== asked);
  }

  wear(tile, evidence) {
    tile.evidence?.dispose();
    tile.evidence = evidence;
    for (const part of tile.levels) part.points.material.uniforms.evidence.value = evidence ?? this.cloud.blank;
    this.cloud.draw();
  }

  // Textures of tiles out of view go once there are too many.
  forget() {
    const worn = this.tiles.filter((tile) => tile.evidence);
    if (worn.length <= 2 * MOST_TOLD) return;
    for (const tile of worn) if (!tile.seen) Object.assign(tile, { told: null }), this.wear(tile, null);
  }

  // Points that came and went, as the server tells them, with shapes of their own.
  changes(buffer, lattice, paired) {
    for (const part of this.marks ?? []) this.cloud.remove(part);
    this.marks = [];
    const view = new DataView(buffer);
    for (let at = 0, gone, come; at < buffer.byteLength; at = come.end) {
      const [row, col] = [view.getInt32(at, true), view.getInt32(at + 4, true)];
      gone = unpack(buffer, at + 8);
      come = unpack(buffer, gone.end);
      const corner = { x: lattice.x0 + col * TILE, y: lattice.y0 + row * TILE, spacing: 0.2 };
      const side = (own) => (paired ? own : "both");
      if (gone.packed.length) this.marks.push(this.cloud.add({ ...corner, ...gone, mark: MARK.removed, side: side("old") }));
      if (come.packed.length) this.marks.push(this.cloud.add({ ...corner, ...come, mark: MARK.added, side: side("new") }));
    }
    this.compared = true;
    this.plan(this.still ? 8 * this.budget : this.budget);
  }
}
