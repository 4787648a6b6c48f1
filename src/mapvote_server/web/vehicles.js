// Which vehicles contradict the others, and where they drove. The server tells reviewers and operators only.

import * as api from "./api.js";
import { showCell } from "./details.js";
import { $, address, element, link, notice, refill, state } from "./page.js";

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
  refill($("vehicles"), against.map(item));
  $("vehicles-note").textContent = !found.length
    ? "No ballot has come yet."
    : (against.length ? "" : "No vehicle contradicts the others significantly. ") +
      (open ? `${open} of ${found.length} cannot be judged yet: others must agree before and after them.` : "");
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

// Lines in both pictures: paths of the drives whose ballots stand, and stretches on which one more pass would decide
// cells.
const GAP_M = 40;  // farther apart: the vehicle did not know where it was in between
const HEAD_M = 4;

const LAYERS = {
  paths: { ask: api.paths, text: driven, features: [] },
  next: { ask: api.passes, text: wanted, features: [] },
};

async function showLayer(name) {
  const layer = LAYERS[name];
  const asked = $(name).checked;
  address.write({ [name]: asked ? "1" : null });
  try {
    layer.features = asked ? (await layer.ask()).features : [];
  } catch (error) {
    return notice(error.message);
  }
  if (asked !== $(name).checked) return;
  $(`${name}-text`).textContent = asked ? layer.text(layer.features) : "";
  const next = LAYERS.next.features.flatMap((f) => [f.geometry.coordinates, head(f.geometry.coordinates)]);
  const paths = LAYERS.paths.features.flatMap((f) => unbroken(f.geometry.coordinates));
  state.view.setPaths("drives", [...next.map((line) => ({ colour: "next", line })), ...paths.map((line) => ({ colour: "path", line }))]);
}

// Once the server has told that it tells: as the address says, and up to date with each new ballot.
export function offerPaths() {
  for (const name of Object.keys(LAYERS)) {
    $(`${name}-row`).hidden = false;
    if (address.read()[name] === "1") $(name).checked = true;
    if ($(name).checked) showLayer(name);
  }
}

function driven(features) {
  const km = features.reduce((sum, f) => sum + f.properties.length_m, 0) / 1000;
  return features.length ? `${features.length} drives, ${km.toFixed(1)} km` : "no ballot carries a path";
}

function wanted(features) {
  const cells = features.reduce((sum, f) => sum + f.properties.cells, 0);
  return features.length ? `${features.length} stretches of road, ${cells} cells` : "no cell waits for one more pass";
}

// The head of an arrow at the end of a line, which says in which direction to drive.
function head(line) {
  const [end, before] = [line.at(-1), line.findLast((at) => Math.hypot(at[0] - line.at(-1)[0], at[1] - line.at(-1)[1]) >= HEAD_M) ?? line[0]];
  const along = Math.atan2(end[1] - before[1], end[0] - before[0]);
  const barb = (turn) => [end[0] - HEAD_M * Math.cos(along + turn), end[1] - HEAD_M * Math.sin(along + turn)];
  return [barb(0.6), end, barb(-0.6)];
}

function unbroken(line) {
  const parts = [[]];
  for (const at of line) {
    const last = parts.at(-1).at(-1);
    if (last && Math.hypot(at[0] - last[0], at[1] - last[1]) > GAP_M) parts.push([]);
    parts.at(-1).push(at);
  }
  return parts.filter((part) => part.length > 1);
}

for (const name of Object.keys(LAYERS)) $(name).onchange = () => showLayer(name);
