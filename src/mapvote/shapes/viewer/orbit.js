// Where the eye is: round a target, at a distance. Drag turns, right or shift drag moves, the wheel comes nearer.

const LOW = 0.03, HIGH = Math.PI / 2 - 0.001;

export class Orbit {
  constructor(surface, changed, pick) {
    Object.assign(this, { surface, changed, pick });
    this.target = [0, 0, 0];  // map metres
    this.distance = 100;
    this.azimuth = -Math.PI / 2;  // bearing from the target to the eye: from the south
    this.elevation = 0.7;
    this.pointers = new Map();
    this.flight = null;
    this.listen();
  }

  get eye() {
    const level = this.distance * Math.cos(this.elevation);
    return [
      this.target[0] + level * Math.cos(this.azimuth),
      this.target[1] + level * Math.sin(this.azimuth),
      this.target[2] + this.distance * Math.sin(this.elevation),
    ];
  }

  get state() {
    return [...this.target, this.distance, this.azimuth, this.elevation];
  }

  set state([x, y, z, distance, azimuth, elevation]) {
    Object.assign(this, { target: [x, y, z], distance, azimuth, elevation });
    this.changed();
  }

  // Comes to see a box [x0, y0, x1, y1] whole, at height z, as a bird would fly; at once for those who want no motion.
  flyTo(box, z, { at_once = false, elevation = this.elevation, azimuth = this.azimuth, margin = 1.25, height = 0 } = {}) {
    const { clientWidth: w, clientHeight: h } = this.surface;
    const turn = Math.abs(Math.sin(azimuth)), dx = box[2] - box[0], dy = box[3] - box[1];
    const wide = dx * turn + dy * (1 - turn), deep = dy * turn + dx * (1 - turn);
    const up = deep * Math.sin(elevation) + height * Math.cos(elevation);
    const span = Math.max(wide * (h / Math.max(w, 1)), up, 6) * margin;
    const end = [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2, z, span / (2 * Math.tan(0.4)) + 0.3 * deep, azimuth, elevation];
    this.flight = null;
    if (at_once || matchMedia("(prefers-reduced-motion: reduce)").matches) return (this.state = end);
    const start = this.state, begun = performance.now(), mine = (this.flight = Symbol());
    const step = (now) => {
      if (this.flight !== mine) return;
      const t = Math.min((now - begun) / 900, 1), s = t * t * (3 - 2 * t);
      this.state = start.map((v, i) => (i === 3 ? v * (end[i] / v) ** s : v + s * (end[i] - v)));
      if (t < 1) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  zoom(factor) {
    this.flight = null;
    this.distance = Math.min(Math.max(this.distance / factor, 1), 50_000);
    this.changed();
  }

  turn(dx, dy) {
    this.flight = null;
    this.azimuth -= dx * 0.006;
    this.elevation = Math.min(Math.max(this.elevation + dy * 0.006, LOW), HIGH);
    this.changed();
  }

  move(dx, dy) {  // pixels; the ground follows the hand
    this.flight = null;
    const metres = (2 * this.distance * Math.tan(0.4)) / this.surface.clientHeight;
    const [c, s] = [Math.cos(this.azimuth), Math.sin(this.azimuth)];
    const ahead = (dy * metres) / Math.max(Math.sin(this.elevation), 0.25);
    this.target = [this.target[0] + dx * metres * s - ahead * c, this.target[1] - dx * metres * c - ahead * s, this.target[2]];
    this.changed();
  }

  listen() {
    const c = this.surface, at = (e) => [e.offsetX, e.offsetY];
    c.addEventListener("contextmenu", (e) => e.preventDefault());
    c.addEventListener("wheel", (e) => (e.preventDefault(), this.zoom(2 ** (-e.deltaY / 400))), { passive: false });
    c.addEventListener("pointerdown", (e) => {
      c.setPointerCapture(e.pointerId);
      this.pointers.set(e.pointerId, at(e));
      this.travelled = this.pointers.size > 1 ? Infinity : 0;
      this.moves = e.button === 2 || e.button === 1 || e.shiftKey || e.ctrlKey;
    });
    c.addEventListener("pointermove", (e) => this.dragged(e.pointerId, at(e)));
    c.addEventListener("pointerup", (e) => {
      if (this.travelled < 4 && e.button === 0) this.pick(at(e));
      this.pointers.delete(e.pointerId);
    });
    c.addEventListener("pointercancel", (e) => this.pointers.delete(e.pointerId));
    c.addEventListener("keydown", (e) => {
      if (e.ctrlKey || e.altKey || e.metaKey) return;
      const [x, y] = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] }[e.key] ?? [0, 0];
      if (x || y) e.shiftKey ? this.turn(x, y) : this.move(x, y);
      else if (e.key === "+" || e.key === "=") this.zoom(1.3);
      else if (e.key === "-") this.zoom(1 / 1.3);
      else if (e.key === "Enter") this.pick([c.clientWidth / 2, c.clientHeight / 2]);
      else return;
      e.preventDefault();
    });
  }

  dragged(id, now) {
    const before = this.pointers.get(id);
    if (!before) return;
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    const other = [...this.pointers].find(([key]) => key !== id)?.[1];
    this.pointers.set(id, now);
    this.travelled += Math.hypot(dx, dy);
    if (this.travelled < 4) return;
    if (other) {  // two fingers: apart is nearer, together they move
      const gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
      this.zoom(gap(now) / gap(before));
      this.move(dx / 2, dy / 2);
    } else if (this.moves) this.move(dx, dy);
    else this.turn(dx, dy);
  }
}
