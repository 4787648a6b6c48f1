// The page: asks the server, fills the panels, listens.

import * as api from "./api.js";
import { showTiles } from "./coverage.js";
import { closeDetails, drawable, follow, showCell, showChange } from "./details.js";
import { $, dot, element, link, notice, when } from "./dom.js";
import { state } from "./page.js";
import { showVehicles } from "./vehicles.js";
import { TILE, View } from "./view.js";

let queue = Promise.resolve();
const asked = new Set();  // hashes on their way

let range = null;  // the last one asked for
const view = (state.view = new View($("map"), {
  onPick: (where, change) => (change ? showChange(change.id) : showCell(where)),
  onMove: showScale,
  wantTile: (hash) => fetchTile(hash),
}));

async function start() {
  try {
    const [manifest, versions, coverage] = await Promise.all([api.manifest(), api.versions(), api.coverage()]);
    Object.assign(state, { manifest, versions: versions.versions, coverage: coverage.tiles });
  } catch (error) {
    return refuse(error);
  }
  $("key-form").hidden = $("notice").hidden = true;
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
  showVehicles();
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
  const mine = (range = Symbol());
  closeDetails();
  let features = [];
  try {
    if (from !== to) features = (await api.changes(from, to)).features;
  } catch (error) {
    refuse(error);
  }
  if (range !== mine) return;
  state.features = features;
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
    asked.delete(hash);
  });
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
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => state.manifest && showTiles());
$("key-form").onsubmit = (event) => {
  event.preventDefault();
  api.key.set($("key").value.trim());
  $("key").value = "";
  start();
};
start();
