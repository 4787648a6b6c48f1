// Tools of the 3D view: colours, before and after, a slice by height, a measured distance.

import { distance } from "./stage.js";
import { COLOUR } from "./shaders.js";
import { $, address, element, notice } from "./page.js";

const BLINK_MS = 800, HIGHEST = 40;
const LEGENDS = {
  height: ["ground", "15 m or more above ground"], plain: [], age: ["2 months ago or earlier", "today"], votes: ["no vote", "9 vehicles or more"],
  probability: ["0", "1"], state: ["unchanged", "changed"],
  intensity: ["dark", "bright"],
};

export class Tools {
  constructor(stage, { setCompare }) {
    Object.assign(this, { stage, cloud: stage.cloud, stream: stage.stream, setCompare });
    this.points = [];
    $("colour").onchange = () => this.colour($("colour").value);
    $("vehicle").onchange = () => this.colour("state");
    this.wanted = address.read().vehicle;  // chosen once the server has told who there is
    $("compare").onchange = () => this.compare($("compare").value);
    $("swipe").oninput = () => this.swipe();
    for (const id of ["slice-low", "slice-high"]) $(id).oninput = () => this.slice();
    $("measure").onclick = () => this.measure(!this.measuring);
    const asked = address.read();
    if (Number.isFinite(Number(asked.swipe ?? NaN))) $("swipe").value = Number(asked.swipe);
    if (asked.slice) [$("slice-low").value, $("slice-high").value] = asked.slice.split(",");
    $("colour").value = asked.colour in COLOUR && asked.colour !== "state" ? asked.colour : "height";
    $("compare").value = ["before", "swipe", "blink"].includes(asked.compare) ? asked.compare : "after";
    const known = $("colour").querySelector("[value=intensity]");
    known.hidden = known.disabled = !this.stream.bright;
    if (known.disabled && $("colour").value === "intensity") $("colour").value = "height";
    this.slice();
    if ($("colour").value !== "height") this.colour($("colour").value);
    if ($("compare").value !== "after") this.compare($("compare").value);
    this.legend("height");
  }

  async colour(name) {
    address.write({ colour: name === "height" ? null : name, vehicle: name === "state" ? $("vehicle").value : null });
    $("vehicle-row").hidden = name !== "state";
    this.legend(name);
    try {
      await this.stream.evidence(COLOUR[name] >= COLOUR.age && name !== "intensity", name === "state" ? $("vehicle").value : undefined);
    } catch (error) {
      return notice(error.message);
    }
    this.cloud.shared.colour.value = COLOUR[name];
    this.cloud.draw();
  }

  legend(name) {
    const ends = LEGENDS[name];
    $("ramp").hidden = !ends.length;
    $("ramp-low").textContent = ends[0] ?? "";
    $("ramp-high").textContent = ends[1] ?? "";
  }

  compare(name) {
    address.write({ compare: name === "after" ? null : name, swipe: null });
    for (const side of document.querySelectorAll(".sides button")) side.ariaPressed = String(side.value === name);
    $("swipe-row").hidden = name !== "swipe";
    $("swipe-bar").hidden = name !== "swipe";
    clearInterval(this.blinking);
    this.setCompare(name !== "after");
    if (name === "swipe") return this.swipe();
    this.cloud.sides = name === "before" ? "old" : "new";
    if (name === "blink")
      this.blinking = setInterval(() => {
        this.cloud.sides = this.cloud.sides === "new" ? "old" : "new";
        $("which").textContent = this.cloud.sides === "new" ? "after" : "before";
        this.stream.plan();
        this.cloud.draw();
      }, BLINK_MS);
    $("which").textContent = name === "before" ? "before" : name === "blink" ? "after" : "";
    this.stream.plan();
    this.cloud.draw();
  }

  swipe() {
    const share = Number($("swipe").value) / 100;
    this.cloud.sides = share;
    $("swipe-bar").style.left = `${100 * share}%`;
    address.write({ swipe: share === 0.5 ? null : $("swipe").value });
    $("which").textContent = "";
    this.stream.plan();
    this.cloud.draw();
  }

  slice() {
    const low = Number($("slice-low").value), high = Number($("slice-high").value);
    const whole = low <= -2 && high >= HIGHEST;
    this.cloud.shared.slice.value.set(low <= -2 ? -1e4 : low, high >= HIGHEST ? 1e4 : high);
    const [from, to] = [`${low.toFixed(1)} m`, `${high.toFixed(1)} m`];
    $("slice-text").textContent = whole ? "all heights" : high >= HIGHEST ? `above ${from}` : low <= -2 ? `below ${to}` : `${from} to ${to}`;
    address.write({ slice: whole ? null : `${low},${high}` });
    this.cloud.draw();
  }

  measure(on) {
    this.measuring = on;
    this.points = [];
    $("measure").setAttribute("aria-pressed", String(on));
    $("measured").replaceChildren();
    $("measured-text").textContent = on ? "Click two points." : "";
  }

  // A point that was clicked: true if measuring took it.
  take(at) {
    if (!this.measuring) return false;
    this.points = this.points.length === 2 ? [at] : [...this.points, at];
    const [a, b] = this.points;
    $("measured-text").textContent = b
      ? `${distance(a, b).toFixed(2)} m (level ${Math.hypot(b[0] - a[0], b[1] - a[1]).toFixed(2)} m, height ${Math.abs(b[2] - a[2]).toFixed(2)} m)`
      : "Click the second point.";
    this.place(this.cloud);
    return true;
  }

  place(cloud) {
    const at = this.points.map((p) => cloud.project(p));
    if (at.some((p) => !p)) return $("measured").replaceChildren();
    const marks = at.map(([x, y]) => mark("circle", { cx: x, cy: y, r: 5 }));
    if (at.length === 2) marks.push(mark("line", { x1: at[0][0], y1: at[0][1], x2: at[1][0], y2: at[1][1] }));
    $("measured").replaceChildren(...marks);
  }

  // Whose votes can be looked at one by one: the server tells reviewers and operators only.
  showVehicles(names) {
    const chosen = this.wanted ?? $("vehicle").value;
    $("vehicle").replaceChildren(...names.map((name) => element("option", { value: name }, [name])));
    if (names.includes(chosen)) $("vehicle").value = chosen;
    const option = $("colour").querySelector("[value=state]");
    option.hidden = option.disabled = !names.length;
    if (!names.includes(this.wanted)) return;
    this.wanted = null;
    $("colour").value = "state";
    this.colour("state");
  }
}

function mark(kind, attributes) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", kind);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}
