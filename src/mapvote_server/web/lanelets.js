// Lanelets, stop lines and signs near the changes that are shown, of a lanelet2 map that is chosen here or dropped on the
// page. The server compares it and keeps nothing.

import * as api from "./api.js";
import { $, element, link, number, refill, state } from "./page.js";

const MOST = 50;  // in the list; the map shows all
let file = null;

export async function showLanelets() {
  if (!file) return;
  const mine = file, [from, to] = [$("from").value, $("to").value];
  const current = () => file === mine && $("from").value === from && $("to").value === to;
  $("lanelets-text").textContent = `comparing ${mine.name}\u2026`;
  let features = [], text = "";
  try {
    features = (await api.lanelets(from, to, mine)).features;
    text = `${mine.name}: ${features.length} part${features.length === 1 ? "" : "s"} within 2 m of these changes`;
  } catch (error) {
    text = error.message;
  }
  if (!current()) return;
  $("lanelets-text").textContent = text + (features.length > MOST ? `; the first ${MOST} are listed` : "");
  refill($("lanelets-near"), features.slice(0, MOST).map(item));
  state.view.setPaths("lanelets", features.flatMap((f) => lines(f.geometry)).map((line) => ({ colour: "lanelet", line })));
}

const item = (f) => {
  const { kind, subtype, id, distance_m, kinds } = f.properties;
  const name = `${kind} ${id}${subtype ? ` (${subtype})` : ""}`;
  return element("li", {}, [link(name, () => state.view.fit(around(f.geometry), 0.2)), ` ${number(distance_m)} m from ${kinds.join(", ")}`]);
};

// The outlines of a geometry of GeoJSON.
export function lines({ type, coordinates }) {
  if (type === "LineString") return [coordinates];
  return type === "MultiPolygon" ? coordinates.flat() : coordinates;
}

function around(geometry) {
  const corners = lines(geometry).flat();
  const [x, y] = [0, 1].map((i) => corners.map((corner) => corner[i]));
  return [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)];
}

function take(chosen) {
  file = chosen ?? file;
  return showLanelets();
}

export function listenForLanelets() {
  $("lanelets").onchange = () => take($("lanelets").files[0]);
  document.addEventListener("dragover", (e) => e.preventDefault());
  document.addEventListener("drop", (e) => (e.preventDefault(), take(e.dataTransfer.files[0])));
}
