// One change, or one cell and the votes behind it.

import * as api from "./api.js";
import { $, address, dot, element, facts, link, number, state, when } from "./page.js";

const STATES = {
  unchanged_occupied: "unchanged, occupied",
  unchanged_empty: "unchanged, empty",
  changed_occupied: "changed, now occupied",
  changed_empty: "changed, now empty",
  undetermined: "undetermined",
};
const CHANGE = { changed_occupied: "built", changed_empty: "demolished" };
let asking = null;

// A feature as the view draws it: polygons and the box around them.
export function drawable(feature) {
  const g = feature.geometry;
  const polygons = g.type === "Polygon" ? [g.coordinates] : g.coordinates;
  const corners = polygons.flatMap((p) => p[0]);
  const xs = corners.map((c) => c[0]), ys = corners.map((c) => c[1]);
  const box = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  const { kind, size, height_m: height } = feature.properties;
  return { id: feature.id, kind, size, height, polygons, box };
}

// How a change is named: one that only took voxels from cells that stand is none of a whole thing.
export function nameOf(p) {
  if (p.kind === "built") return "Built";
  return p.trimmed === p.cells ? "Trimmed beside what stands" : "Demolished";
}

export function showChange(id) {
  const feature = state.features.find((f) => f.id === id);
  if (!feature) return;
  const p = feature.properties, [x, y] = drawable(feature).polygons[0][0][0];
  address.write({ change: id, cell: null });
  address.flush();
  asking = null;
  mark(id);
  state.view.select(id);
  details(nameOf(p), p.kind, [
    facts([
      ["area", `${p.area_m2.toFixed(2)} m\u00b2 (${p.cells} cells)`],
      ["height", `${p.height_m.toFixed(1)} m above ground`],
      p.volume_m3 !== undefined && ["column volume", `${p.volume_m3.toFixed(1)} m\u00b3`],
      ["points", `${p.points} ${p.kind === "built" ? "added" : "deleted"}`],
      ["votes for it", p.versions.length > 0 ? `${number(p.votes_median)} (fewest ${p.votes_min})` : "none: a rollback or replay took a decision back"],
      Number.isFinite(p.probability) && ["probability", `${Math.round(100 * p.probability)} %, mean of its cells`],
      p.against_median !== undefined && p.versions.length > 0 && ["votes against", number(p.against_median)],
      p.first_seen && ["first seen", when(p.first_seen)],
      p.last_seen && ["last seen", when(p.last_seen)],
      p.versions.length > 0 && [p.versions.length > 1 ? "versions" : "version", p.versions.join(", ")],
    ]),
    p.near?.length > 0 && element("p", { className: "hint" }, ["near it: ", ...p.near.map((other) => near(other))]),
    sides(),
    link("Votes on one of its cells", () => showCell([x + 0.15, y + 0.15])),
  ]);
}

// Before and after in 3D, beside the change that they are about.
export function sides() {
  if (!state.view.cloud) return false;
  const shown = $("compare").value;
  const side = ([name, text]) => element("button", { type: "button", value: name, ariaPressed: String(name === shown), onclick: () => state.view.compare(name) }, [text]);
  return element("p", { className: "row sides" }, [["before", "Before"], ["after", "After"], ["swipe", "Swipe"]].map(side));
}

function near(id) {
  const feature = state.features.find((f) => f.id === id);
  const text = feature ? `${feature.properties.kind}, ${feature.properties.area_m2.toFixed(0)} m\u00b2 ` : id;
  return link(text, () => feature && (showChange(id), visit(feature)));
}

export async function showCell([x, y]) {
  address.write({ cell: `${x.toFixed(2)},${y.toFixed(2)}`, change: null });
  address.flush();
  mark(null);
  const { x0, y0 } = state.manifest.lattice;
  const corner = [x0 + Math.floor((x - x0) / 0.3) * 0.3, y0 + Math.floor((y - y0) / 0.3) * 0.3];
  state.view.select(null, corner);
  const title = `Cell at x ${(corner[0] + 0.15).toFixed(2)}, y ${(corner[1] + 0.15).toFixed(2)}`;
  const mine = (asking = Symbol());
  let answer;
  try {
    answer = await api.cell(x, y);
  } catch (error) {
    return details(title, null, [element("p", {}, [error.message])]);
  }
  if (asking !== mine) return;  // something else was chosen meanwhile
  const vote = (v) =>
    element("li", { className: v.counts ? "" : "silent" }, [
      element("div", { className: "head" }, [element("b", {}, [`${v.vehicle} / ${v.drive}`]), element("time", {}, [when(v.end)])]),
      element("div", {}, [CHANGE[v.state] && dot(CHANGE[v.state]), STATES[v.state] ?? v.state, sure(v)]),
      v.marks > 0 && v.state === "unchanged_occupied"
        && element("div", {}, [`but ${v.marks} of its voxels ${v.marks > 1 ? "are" : "is"} gone`]),
      v.counted_in?.length > 0 && element("div", { className: "why" }, [`counted in ${versions(v.counted_in)}`]),
      v.clouds && element("div", { className: "why" }, [`the vehicle kept its clouds of this place: ${v.clouds}`]),
      ...(v.left_out_of ?? []).slice(-2).map(({ version, why }) => element("div", { className: "why" }, [`not counted in version ${version}: ${why}`])),
      !v.counts && element("div", { className: "why" }, [`does not count now: ${v.why || "no reason given"}`]),
    ]);
  const edited = ({ state, votes, against }) => `; points ${state === "changed_empty" ? "deleted" : "added"} by ${votes} of ${votes + against} vehicles`;
  const decided = answer.decisions.map((d) => `Version ${d.version} decided: ${STATES[d.state] ?? d.state}${d.edit ? edited(d.edit) : ""}${d.fell ? `; ${d.fell}` : ""}.`);
  if (/^(pending|trimmed):/.test(answer.thing)) decided.push(`${answer.thing}.`);
  details(title, null, [
    ...decided.map((text) => element("p", {}, [text])),
    answer.votes.length
      ? element("ol", { className: "votes" }, answer.votes.map(vote))
      : element("p", { className: "hint" }, ["No ballot says anything about this cell."]),
    answer.unlisted > 0 && element("p", { className: "hint" }, [`${answer.unlisted} older votes on the tile do not count and are not listed.`]),
  ]);
}

const versions = (numbers) => `version${numbers.length > 1 ? "s" : ""} ${numbers.join(", ")}`;

// What a vehicle says of its own evidence, if it does.
const sure = (vote) => (Number.isFinite(vote.sure) ? `, ${Math.round(100 * vote.sure)} % sure` : "");

function details(title, kind, content) {
  $("details").replaceChildren(
    element("button", { className: "close", title: "Close", ariaLabel: "Close", onclick: closeDetails }, ["\u00d7"]),
    element("h2", { className: "unseen" }, ["Chosen"]),
    element("h3", {}, [kind && dot(kind), title]),
    ...content.filter(Boolean),
  );
  $("details").hidden = false;
}

export function closeDetails() {
  $("details").hidden = true;
  mark(null);
  state.view.select(null);
}

function mark(id) {
  for (const button of document.querySelectorAll("#changes button, #vehicles-maybe button, #small button"))
    button.setAttribute("aria-current", String(button.parentElement.id === `item-${id}`));
}

// A link to one change or one cell.
export function follow() {
  const asked = address.read();
  if (asked.change) {
    const feature = state.features.find((f) => f.id === asked.change);
    if (feature && !asked.eye) visit(feature);
    showChange(asked.change);
  } else if (asked.cell) {
    const where = asked.cell.split(",").map(Number);
    if (where.length !== 2 || !where.every(Number.isFinite)) return;
    if (!asked.eye) state.view.fit([where[0] - 10, where[1] - 10, where[0] + 10, where[1] + 10], 0.1, { at_once: true });
    showCell(where);
  }
}

// Brings a change into view.
export function visit(feature) {
  const change = drawable(feature);
  state.view.fit(change.box, 0.38, { elevation: 0.5, height: change.height });
}
