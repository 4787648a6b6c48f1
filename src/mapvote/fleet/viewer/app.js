// The panels beside the map, and what happens when something is chosen. Text from the server is only ever text.

import * as api from "./api.js";
import { TILE, View } from "./view.js";

const $ = (id) => document.getElementById(id);
const DAY = 86400e3;
const STATES = {
  unchanged_occupied: "unchanged, occupied",
  unchanged_empty: "unchanged, empty",
  changed_occupied: "changed, now occupied",
  changed_empty: "changed, now empty",
  undetermined: "undetermined",
};
const CHANGE = { changed_occupied: "built", changed_empty: "demolished" };
const SHADES = {
  seen: { of: (t) => seenStep(t.last_seen), labels: ["1 day", "1 week", "1 month", "older", "never"] },
  vehicles: { of: (t) => vehicleStep(t.vehicles), labels: ["9+", "4-8", "2-3", "1", "0"] },
  none: { of: () => 4, labels: [] },
};
const STRENGTH = [0.42, 0.28, 0.17, 0.09, 0];
const state = { manifest: null, versions: [], coverage: [], features: [], shade: "seen" };
let queue = Promise.resolve();
const asked = new Set();

const view = new View($("map"), {
  onPick: (where, change) => (change ? showChange(change.id) : showCell(where)),
  onMove: showScale,
  wantTile: (hash) => fetchTile(hash),
});

async function start() {
  try {
    const [manifest, versions, coverage] = await Promise.all([api.manifest(), api.versions(), api.coverage()]);
    Object.assign(state, { manifest, versions: versions.versions, coverage: coverage.tiles });
  } catch (error) {
    return refuse(error);
  }
  $("key-form").hidden = true;
  $("content").hidden = false;
  $("forget").hidden = !api.key.get();
  $("which-map").textContent = `${state.manifest.map_id}, version ${state.manifest.version}`;
  document.title = `mapvote: ${state.manifest.map_id}`;
  showVersions();
  fillRange();
  showTiles();
  view.fit(extent(view.tiles));
  await showRange();
  follow();
}

function refuse(error) {
  $("which-map").textContent = location.host;
  if (error.status === 401 || error.status === 403) {
    $("key-form").hidden = false;
    $("content").hidden = true;
    if (api.key.get()) $("key-reason").textContent = error.message;
    api.key.forget();
    $("key").focus();
  } else notice(error.message);
}

// ---- versions and the range between two of them

function showVersions() {
  const newest = state.manifest.version;
  const item = (v) =>
    element("li", {}, [
      element("div", { className: "head" }, [
        element("b", {}, [`Version ${v.number}`]),
        element("time", { title: v.created }, [when(v.created)]),
      ]),
      element("p", {}, [v.reason || "no reason given"]),
      element("p", { className: "by" }, [`${KIND[v.kind]?.(v) ?? v.kind} by ${v.published_by}`]),
      v.number > 1 && link("Show its changes", () => setRange(v.number - 1, v.number)),
      v.number !== newest && link("How to go back to it", (e) => e.target.replaceWith(howToRollBack(v.number))),
    ]);
  $("versions").replaceChildren(...[...state.versions].reverse().map(item));
}

const KIND = {
  import: () => "imported",
  publish: () => "published",
  rollback: (v) => `rolled back to version ${v.target}`,
  replay: (v) => `replayed from version ${v.target}`,
};

const howToRollBack = (number) =>
  element("span", { className: "hint" }, [
    element("code", {}, [`mapvote rollback STORE ${number}`]),
    " publishes it again as a new version; votes that led away from it are barred.",
  ]);

function fillRange() {
  const numbers = state.versions.map((v) => v.number);
  const options = () => numbers.map((n) => element("option", { value: n }, [String(n)]));
  $("from").replaceChildren(...options());
  $("to").replaceChildren(...options());
  $("to").value = state.manifest.version;
  $("from").value = Math.max(numbers[0], state.manifest.version - 1);
}

function setRange(from, to) {
  $("from").value = from;
  $("to").value = to;
  return showRange();
}

async function showRange() {
  const [from, to] = [$("from").value, $("to").value];
  closeDetails();
  try {
    state.features = from === to ? [] : (await api.changes(from, to)).features;
  } catch (error) {
    state.features = [];
    refuse(error);
  }
  state.features.sort((a, b) => b.properties.area_m2 - a.properties.area_m2);
  view.setChanges(state.features.map(drawable));
  const count = (kind) => state.features.filter((f) => f.properties.kind === kind).length;
  $("tally").replaceChildren(
    ...(state.features.length
      ? [dot("built"), `${count("built")} built `, " \u2002 ", dot("demolished"), `${count("demolished")} demolished`]
      : [element("span", { className: "hint" }, [nothing(from, to)])]),
  );
  const row = (f) =>
    element("li", {}, [
      element("button", { onclick: () => (showChange(f.id), view.fit(drawable(f).box, 0.38)) }, [
        dot(f.properties.kind),
        f.properties.kind === "built" ? "Built" : "Demolished",
        element("span", { className: "number" }, [`${f.properties.area_m2.toFixed(1)} m\u00b2`]),
        element("span", { className: "number" }, [`${f.properties.height_m.toFixed(1)} m high`]),
      ]),
    ]);
  const items = state.features.map((f) => Object.assign(row(f), { id: `item-${f.id}` }));
  $("changes").replaceChildren(...items);
}

const nothing = (from, to) =>
  state.versions.length < 2
    ? "Only the first map is here. Changes appear once vehicles have voted and a version is published."
    : from === to
      ? "Choose two different versions."
      : `Nothing changed between version ${from} and version ${to}.`;

function drawable(feature) {
  const g = feature.geometry;
  const polygons = g.type === "Polygon" ? [g.coordinates] : g.coordinates;
  const corners = polygons.flatMap((p) => p[0]);
  const xs = corners.map((c) => c[0]), ys = corners.map((c) => c[1]);
  const box = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  return { id: feature.id, kind: feature.properties.kind, polygons, box };
}

// ---- details of one change, one cell

function showChange(id) {
  const feature = state.features.find((f) => f.id === id);
  if (!feature) return;
  const p = feature.properties, [x, y] = drawable(feature).polygons[0][0][0];
  location.replace(`#change=${encodeURIComponent(id)}`);
  mark(id);
  view.select(id);
  details(p.kind === "built" ? "Built" : "Demolished", p.kind, [
    facts([
      ["area", `${p.area_m2.toFixed(2)} m\u00b2 (${p.cells} cells)`],
      ["height", `${p.height_m.toFixed(1)} m above ground`],
      ["points", `${p.points} ${p.kind === "built" ? "added" : "deleted"}`],
      ["votes for it", p.votes_median ? `${number(p.votes_median)} (fewest ${p.votes_min})` : "unknown"],
      ["first seen", when(p.first_seen)],
      ["last seen", when(p.last_seen)],
      [p.versions.length > 1 ? "versions" : "version", p.versions.join(", ") || "unknown"],
    ]),
    link("Who voted here?", () => showCell([x + 0.15, y + 0.15])),
  ]);
}

async function showCell([x, y]) {
  location.replace(`#cell=${x.toFixed(2)},${y.toFixed(2)}`);
  mark(null);
  const { x0, y0 } = state.manifest.lattice;
  const corner = [x0 + Math.floor((x - x0) / 0.3) * 0.3, y0 + Math.floor((y - y0) / 0.3) * 0.3];
  view.select(null, corner);
  const title = `Cell at x ${(corner[0] + 0.15).toFixed(2)}, y ${(corner[1] + 0.15).toFixed(2)}`;
  let answer;
  try {
    answer = await api.cell(x, y);
  } catch (error) {
    return details(title, null, [element("p", {}, [error.message])]);
  }
  const vote = (v) =>
    element("li", { className: v.counts ? "" : "silent" }, [
      element("div", { className: "head" }, [element("b", {}, [`${v.vehicle} / ${v.drive}`]), element("time", {}, [when(v.end)])]),
      element("div", {}, [CHANGE[v.state] && dot(CHANGE[v.state]), STATES[v.state] ?? v.state]),
      !v.counts && element("div", {}, [`does not count: ${v.why || "no reason given"}`]),
    ]);
  const decided = answer.decisions.map((d) => `Version ${d.version} decided: ${STATES[d.state] ?? d.state}.`);
  details(title, null, [
    answer.votes.length
      ? element("ol", { className: "votes" }, answer.votes.map(vote))
      : element("p", { className: "hint" }, ["No vehicle has voted on this cell."]),
    ...decided.map((text) => element("p", { className: "hint" }, [text])),
  ]);
}

function details(title, kind, content) {
  $("details").replaceChildren(
    element("button", { className: "close", title: "Close", onclick: closeDetails }, ["\u00d7"]),
    element("h3", {}, [kind && dot(kind), title]),
    ...content,
  );
  $("details").hidden = false;
}

function closeDetails() {
  $("details").hidden = true;
  mark(null);
  view.select(null);
}

function mark(id) {
  for (const button of $("changes").querySelectorAll("button"))
    button.setAttribute("aria-current", String(button.parentElement.id === `item-${id}`));
}

function follow() {  // a link to one change or one cell
  const [, what, value] = location.hash.match(/^#(change|cell)=(.+)$/) ?? [];
  if (what === "change") {
    const feature = state.features.find((f) => f.id === decodeURIComponent(value));
    if (feature) view.fit(drawable(feature).box, 0.38);
    showChange(decodeURIComponent(value));
  } else if (what === "cell") {
    const where = value.split(",").map(Number);
    if (where.length !== 2 || !where.every(Number.isFinite)) return;
    view.fit([where[0] - 10, where[1] - 10, where[0] + 10, where[1] + 10]);
    showCell(where);
  }
}

// ---- coverage

function showTiles() {
  const shade = SHADES[state.shade], rgb = getComputedStyle(document.documentElement).getPropertyValue("--shade");
  const { x0, y0 } = state.manifest.lattice;
  const known = new Map();
  for (const [name, tile] of Object.entries(state.manifest.tiles)) known.set(name, { hash: tile.points, last_seen: null, vehicles: 0 });
  for (const t of state.coverage) known.set(`${t.row},${t.col}`, { ...known.get(`${t.row},${t.col}`), ...t });
  const fill = (step) => `rgba(${rgb}, ${STRENGTH[step]})`;
  view.setTiles(
    [...known].map(([name, t]) => {
      const [row, col] = name.split(",").map(Number);
      return { row, col, x: x0 + col * TILE, y: y0 + row * TILE, hash: t.hash, fill: fill(shade.of(t)) };
    }),
  );
  const swatch = (label, i) => {
    const bar = document.createElement("i");
    bar.style.background = fill(i);
    return element("li", {}, [bar, label]);
  };
  $("legend").replaceChildren(...shade.labels.map(swatch));
  const unseen = [...known.values()].filter((t) => !t.vehicles).length;
  $("coverage-note").textContent = !state.coverage.length
    ? "No vehicle has reported yet."
    : `${known.size - unseen} of ${known.size} tiles (76.8 m) seen by a vehicle.`;
  if (!known.size) notice("This map has no tiles yet.", true);
}

function seenStep(stamp) {
  if (!stamp) return 4;
  const age = Date.now() - Date.parse(stamp);
  return age <= DAY ? 0 : age <= 7 * DAY ? 1 : age <= 31 * DAY ? 2 : 3;
}

const vehicleStep = (n) => (n >= 9 ? 0 : n >= 4 ? 1 : n >= 2 ? 2 : n >= 1 ? 3 : 4);

function extent(tiles) {
  if (!tiles.length) return [-TILE, -TILE, TILE, TILE];
  const xs = tiles.map((t) => t.x), ys = tiles.map((t) => t.y);
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs) + TILE, Math.max(...ys) + TILE];
}

function fetchTile(hash) {  // one after the other: the votes matter more than the picture
  if (asked.has(hash)) return;
  asked.add(hash);
  queue = queue.then(async () => {
    try {
      view.setRaster(hash, await api.points(hash));
    } catch {
      view.setRaster(hash, new Float32Array(0));
    }
  });
}

// ---- small things

function element(tag, properties, children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children.filter(Boolean));
  return made;
}

const dot = (kind) => element("span", { className: `dot ${kind}` }, []);
const link = (text, onclick) => element("button", { className: "link", type: "button", onclick }, [text]);
const facts = (pairs) => element("dl", {}, pairs.flatMap(([k, v]) => [element("dt", {}, [k]), element("dd", {}, [v])]));
const number = (n) => (Number.isInteger(n) ? String(n) : n.toFixed(1));
const when = (stamp) => (stamp ? stamp.slice(0, 16).replace("T", " ") + " UTC" : "unknown");

function notice(text, empty = false) {
  $("notice").textContent = text;
  $("notice").className = empty ? "empty" : "";
  $("notice").hidden = false;
}

function showScale(v) {
  const target = 110 / v.scale, power = 10 ** Math.floor(Math.log10(target));
  const metres = [5, 2, 1].map((m) => m * power).find((m) => m <= target) ?? power;
  $("scale-bar").style.width = `${metres * v.scale}px`;
  $("scale-text").textContent = metres >= 1000 ? `${metres / 1000} km` : `${Number(metres.toPrecision(1))} m`;
  $("cursor").textContent = v.cursor ? `x ${v.cursor[0].toFixed(1)}  y ${v.cursor[1].toFixed(1)}` : "";
}

$("zoom-in").onclick = () => view.zoom(1.6);
$("zoom-out").onclick = () => view.zoom(1 / 1.6);
$("fit").onclick = () => view.fit(extent(view.tiles));
$("from").onchange = $("to").onchange = showRange;
$("forget").onclick = () => (api.key.forget(), location.reload());
for (const radio of document.getElementsByName("shade"))
  radio.onchange = () => ((state.shade = radio.value), showTiles());
$("key-form").onsubmit = (event) => {
  event.preventDefault();
  api.key.set($("key").value.trim());
  $("key").value = "";
  start();
};
start();
