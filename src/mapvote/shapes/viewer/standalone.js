// Changes cut out of their map, in a page of their own: turn them, look before and after.

import { Cloud, groundOf } from "./cloud.js";
import { MARK } from "./shaders.js";

const home = document.querySelector(".cutouts"), [which, when] = home.querySelectorAll(".row");
const all = JSON.parse(document.getElementById("cutouts").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
let parts = [], chosen = 0, side = "marked";

function unpack(buffer) {
  const view = new DataView(buffer);
  return { z0: view.getFloat32(8, true), zStep: view.getFloat32(12, true), packed: new Uint16Array(buffer, 16, 4 * view.getUint32(4, true)) };
}

function show() {
  const c = all[chosen];
  for (const part of parts) cloud.remove(part);
  parts = [];
  cloud.origin = [c.x, c.y, 0];
  const add = (name, mark) => parts.push(cloud.add({ x: c.x, y: c.y, spacing: 0.24, mark, ...unpack(bytes(c[name])) }));
  add("kept", MARK.none);
  if (side !== "after") add("removed", side === "before" ? MARK.none : MARK.removed);
  if (side !== "before") add("added", side === "after" ? MARK.none : MARK.added);
  home.querySelector(".told").textContent = c.facts;
  press();
}

function turn(at) {
  chosen = at;
  show();
  const c = all[at], ground = groundOf(unpack(bytes(c.kept)));
  cloud.orbit.flyTo(c.box, ground + c.height / 3, { at_once: true, elevation: 0.5, margin: 1.7, height: c.height });
}

function press() {
  [...which.children].forEach((b, i) => b.setAttribute("aria-pressed", String(i === chosen)));
  [...when.children].forEach((b) => b.setAttribute("aria-pressed", String(b.value === side)));
}

function button(text, onclick, value = "") {
  return Object.assign(document.createElement("button"), { textContent: text, onclick, value, type: "button" });
}

let cloud = null;
try {
  cloud = new Cloud(home.querySelector("canvas"));
} catch {
  home.querySelector(".told").textContent = "This browser shows no 3D (WebGL 2 is off).";
}
if (cloud) {
  which.replaceChildren(...all.map((c, i) => button(c.name, () => turn(i))));
  const sides = [["what changed", "marked"], ["before", "before"], ["after", "after"]];
  when.replaceChildren(...sides.map(([text, value]) => button(text, () => ((side = value), show()), value)));
  turn(0);
}
