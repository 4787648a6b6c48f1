// Which vehicles contradict the others, and where. For operators; to anyone else the server does not tell.

import * as api from "./api.js";
import { showCell } from "./details.js";
import { $, element, link } from "./dom.js";
import { offerPaths } from "./paths.js";
import { state } from "./page.js";

const MOST = 5;

export async function showVehicles() {
  let found;
  try {
    found = (await api.vehicles()).vehicles;
  } catch {
    return;
  }
  offerPaths();
  state.view.tools?.showVehicles(found.map((v) => v.vehicle));
  const against = found.filter((v) => v.verdict === "contradicts");
  const open = found.filter((v) => v.verdict === "undecidable").length;
  $("vehicles").replaceChildren(...against.map(item));
  $("vehicles-note").textContent = !found.length
    ? "No vehicle has reported yet."
    : (against.length ? "" : "No vehicle contradicts the others more than chance. ") +
      (open ? `${open} of ${found.length} cannot be judged yet: others must agree both before and after them.` : "");
  $("vehicle-section").hidden = false;
}

const item = (v) =>
  element("li", {}, [
    element("div", { className: "head" }, [element("b", {}, [v.vehicle]), element("span", {}, [`${v.objects} contradictions`])]),
    element("p", { className: "hint" }, [
      `Chance of this at twice the others' rate: ${v.p_value < 1e-4 ? "below 0.0001" : v.p_value.toFixed(4)}.`,
    ]),
    ...v.evidence.slice(0, MOST).map((e) =>
      element("div", {}, [link(`says ${e.says} at ${e.x.toFixed(1)}, ${e.y.toFixed(1)} (${e.cells} cells)`, () => visit(e))])),
  ]);

function visit(e) {
  const half = Math.max(8, Math.sqrt(e.cells) * 0.3);
  state.view.fit([e.x - half, e.y - half, e.x + half, e.y + half], 0.2);
  showCell([e.x, e.y]);
}
