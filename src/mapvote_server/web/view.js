// The map seen from above: pan, zoom, tiles, points, change objects. Knows nothing of the server.

const CELL = 0.3, TILE_CELLS = 256;
export const TILE = CELL * TILE_CELLS;
const SMALLEST_MARK = 5;  // pixels: a smaller object gets a ring around it

export class View {
  constructor(canvas, { onPick, onMove, wantTile }) {
    Object.assign(this, { canvas, onPick, onMove, wantTile });
    this.context = canvas.getContext("2d");
    this.centre = [0, 0];
    this.scale = 2;  // pixels per metre
    this.tiles = [];
    this.changes = [];
    this.paths = [];
    this.rasters = new Map();
    this.pointers = new Map();
    new ResizeObserver(() => this.resize()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.readColours());
    this.readColours();
    this.listen();
  }

  readColours() {
    const style = getComputedStyle(document.documentElement);
    const of = (name) => style.getPropertyValue(name).trim();
    this.colours = { built: of("--built"), demolished: of("--demolished"), line: of("--line"), ink: of("--ink"), point: of("--point"), path: of("--path"), next: of("--next"), lanelet: of("--lanelet") };
    this.rasters.clear();
    this.draw();
  }

  setTiles(tiles) {  // {row, col, x, y, fill, hash}
    this.tiles = tiles;
    this.draw();
  }

  setChanges(changes) {  // {id, kind, polygons, box}
    this.changes = changes;
    this.draw();
  }

  setPaths(paths) {  // {colour: "path", "next" or "lanelet", line: of [x, y, ..]}
    this.paths = paths;
    this.draw();
  }

  select(id, cell = null) {
    this.selected = id;
    this.cell = cell;
    this.draw();
  }

  setRaster(hash, points) {
    this.rasters.set(hash, raster(points, this.colours.point));
    this.draw();
  }

  fit(box, margin = 0.1) {  // [x0, y0, x1, y1] in map metres
    const [w, h] = [this.canvas.clientWidth || 1, this.canvas.clientHeight || 1];
    const [dx, dy] = [Math.max(box[2] - box[0], 4), Math.max(box[3] - box[1], 4)];
    this.centre = [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2];
    this.scale = clamp(Math.min(w / dx, h / dy) * (1 - 2 * margin), 0.002, 60);
    this.draw();
  }

  zoom(factor, at = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2]) {
    const before = this.toMap(at);
    this.scale = clamp(this.scale * factor, 0.002, 200);
    const after = this.toMap(at);
    this.centre = [this.centre[0] + before[0] - after[0], this.centre[1] + before[1] - after[1]];
    this.draw();
  }

  pan(dx, dy) {
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.draw();
  }

  toMap([px, py]) {
    const c = this.canvas;
    return [this.centre[0] + (px - c.clientWidth / 2) / this.scale, this.centre[1] - (py - c.clientHeight / 2) / this.scale];
  }

  toScreen([x, y]) {
    const c = this.canvas;
    return [(x - this.centre[0]) * this.scale + c.clientWidth / 2, c.clientHeight / 2 - (y - this.centre[1]) * this.scale];
  }

  changeAt(px) {
    const slack = SMALLEST_MARK + 3;
    const inside = (c) => {
      const [x0, y1] = this.toScreen([c.box[0], c.box[1]]), [x1, y0] = this.toScreen([c.box[2], c.box[3]]);
      return px[0] > x0 - slack && px[0] < x1 + slack && px[1] > y0 - slack && px[1] < y1 + slack;
    };
    const hit = (c) => this.context.isPointInPath(this.path(c), px[0], px[1], "evenodd");
    const near = this.changes.filter(inside);
    return near.find(hit) ?? near.find((c) => this.isSmall(c)) ?? null;
  }

  isSmall(change) {
    return Math.max(change.box[2] - change.box[0], change.box[3] - change.box[1]) * this.scale < 2 * SMALLEST_MARK;
  }

  path(change) {
    const path = new Path2D();
    for (const polygon of change.polygons)
      for (const ring of polygon) {
        ring.forEach((corner, i) => (i ? path.lineTo(...this.toScreen(corner)) : path.moveTo(...this.toScreen(corner))));
        path.closePath();
      }
    return path;
  }

  resize() {
    const ratio = devicePixelRatio || 1;
    this.canvas.width = Math.round(this.canvas.clientWidth * ratio);
    this.canvas.height = Math.round(this.canvas.clientHeight * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.paint();
  }

  draw() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = null;
      this.paint();
    });
  }

  paint() {
    const { context: g, canvas } = this;
    g.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    g.imageSmoothingEnabled = this.scale < 1 / CELL;
    for (const tile of this.tiles) this.paintTile(g, tile);
    for (const { colour, line } of this.paths) {
      g.strokeStyle = this.colours[colour];
      g.lineWidth = colour === "path" ? 2 : 4;
      g.beginPath();
      for (const at of line) g.lineTo(...this.toScreen(at));
      g.stroke();
    }
    for (const change of this.changes) this.paintChange(g, change);
    if (this.cell) {
      const [x, y] = this.toScreen([this.cell[0], this.cell[1] + CELL]), side = CELL * this.scale;
      g.strokeStyle = this.colours.ink;
      g.lineWidth = 1.5;
      const grow = Math.max(0, (8 - side) / 2);
      g.strokeRect(x - grow, y - grow, side + 2 * grow, side + 2 * grow);
    }
    this.onMove?.(this);
  }

  paintTile(g, tile) {
    const [x, y] = this.toScreen([tile.x, tile.y + TILE]), side = TILE * this.scale;
    if (x > this.canvas.clientWidth || y > this.canvas.clientHeight || x + side < 0 || y + side < 0) return;
    g.fillStyle = tile.fill;
    g.fillRect(x, y, side, side);
    const image = tile.hash && this.rasters.get(tile.hash);
    if (image) g.drawImage(image, x, y, side, side);
    else if (tile.hash && side > 40) this.wantTile(tile.hash);
    if (side > 24) {
      g.strokeStyle = this.colours.line;
      g.lineWidth = 1;
      g.strokeRect(Math.round(x) + 0.5, Math.round(y) + 0.5, Math.round(side), Math.round(side));
    }
  }

  paintChange(g, change) {
    const path = this.path(change), chosen = change.id === this.selected;
    g.fillStyle = g.strokeStyle = this.colours[change.kind];
    g.globalAlpha = chosen ? 0.8 : 0.65;
    g.fill(path, "evenodd");
    g.globalAlpha = 1;
    g.lineWidth = chosen ? 2.5 : 1;
    g.stroke(path);
    if (!this.isSmall(change)) return;
    const [x, y] = this.toScreen([(change.box[0] + change.box[2]) / 2, (change.box[1] + change.box[3]) / 2]);
    g.beginPath();
    g.arc(x, y, SMALLEST_MARK + (chosen ? 4 : 0), 0, 2 * Math.PI);
    g.stroke();
  }

  listen() {
    const c = this.canvas, at = (e) => [e.offsetX, e.offsetY];
    c.addEventListener("wheel", (e) => (e.preventDefault(), this.zoom(2 ** (-e.deltaY / 300), at(e))), { passive: false });
    c.addEventListener("pointerdown", (e) => {
      c.setPointerCapture(e.pointerId);
      this.pointers.set(e.pointerId, at(e));
      this.travelled = this.pointers.size > 1 ? Infinity : 0;
    });
    c.addEventListener("pointermove", (e) => this.moved(e.pointerId, at(e)));
    c.addEventListener("pointerup", (e) => {
      if (this.travelled < 4) this.onPick(this.toMap(at(e)), this.changeAt(at(e)));
      this.pointers.delete(e.pointerId);
      c.classList.remove("moving");
    });
    c.addEventListener("pointercancel", (e) => this.pointers.delete(e.pointerId));
    c.addEventListener("dblclick", (e) => this.zoom(2, at(e)));
    c.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] }[e.key];
      if (step) this.pan(...step);
      else if (e.key === "+" || e.key === "=") this.zoom(1.4);
      else if (e.key === "-") this.zoom(1 / 1.4);
      else if (e.key === "Enter") this.onPick(this.centre, this.changeAt(this.toScreen(this.centre)));
      else return;
      e.preventDefault();
    });
  }

  moved(id, now) {
    this.cursor = this.toMap(now);
    const before = this.pointers.get(id);
    if (!before) {
      this.canvas.classList.toggle("over", Boolean(this.changeAt(now)));
      this.onMove?.(this);
      return;
    }
    const others = [...this.pointers].filter(([other]) => other !== id).map(([, p]) => p);
    this.pointers.set(id, now);
    this.travelled += Math.hypot(now[0] - before[0], now[1] - before[1]);
    if (this.travelled >= 4) this.canvas.classList.add("moving");
    if (others.length) {
      const gap = (p) => Math.hypot(p[0] - others[0][0], p[1] - others[0][1]) || 1;
      this.zoom(gap(now) / gap(before), others[0]);
    } else this.pan(now[0] - before[0], now[1] - before[1]);
  }
}

// A tile's points as a picture, one pixel a cell: the higher above the tile's low ground, the darker.
function raster(points, colour) {
  const image = new OffscreenCanvas(TILE_CELLS, TILE_CELLS), g = image.getContext("2d");
  const top = new Float32Array(TILE_CELLS * TILE_CELLS).fill(-Infinity);
  const heights = [];
  for (let i = 0; i < points.length; i += 3) {
    const col = Math.floor(points[i] / CELL), row = Math.floor(points[i + 1] / CELL);
    if (col < 0 || row < 0 || col >= TILE_CELLS || row >= TILE_CELLS) continue;
    const at = (TILE_CELLS - 1 - row) * TILE_CELLS + col;
    top[at] = Math.max(top[at], points[i + 2]);
    if (i % 300 === 0) heights.push(points[i + 2]);
  }
  heights.sort((a, b) => a - b);
  const low = heights[Math.floor(heights.length * 0.1)] ?? 0;
  const pixels = g.createImageData(TILE_CELLS, TILE_CELLS);
  const rgb = colour.split(",").map(Number);
  for (let at = 0; at < top.length; at++) {
    if (top[at] === -Infinity) continue;
    pixels.data.set(rgb, 4 * at);
    pixels.data[4 * at + 3] = 255 * clamp(0.1 + 0.12 * (top[at] - low), 0.08, 0.85);
  }
  g.putImageData(pixels, 0, 0);
  return image;
}

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
