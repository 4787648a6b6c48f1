// The page: asks the server, fills the panels, listens.

import * as api from "./api.js";
import { showTiles } from "./coverage.js";
import { closeDetails, drawable, follow, showCell, showChange } from "./details.js";
import { choose, confirm, goBack, showDesk } from "./desk.js";
import { listenForLanelets, showLanelets } from "./lanelets.js";
import { showList } from "./list.js";
import { Stage } from "./stage.js";
import { listen } from "./live.js";
import { showVehicles } from "./vehicles.js";
import { TILE } from "./view.js";
import { $, address, element, link, notice, state, when } from "./page.js";

let queue = Promise.resolve();
let starting = null;  // the newest start: an older one's answers may come later
const asked = new Set();  // hashes on their way

let range = null;  // {from, to, list, clouds}: the two versions that are shown, and what was asked about them
const view = (state.view = new Stage(api, {
  onPick: (where, change) => (change && !change.pending ? showChange(change.id) : where && showCell(where)),
  onMove: showScale,
}));
view.onWanted = (hash) => fetchTile(hash);

async function start() {
  const known = (starting = Promise.all([api.versions(), api.manifest()]));  // before the overview: small, and more is asked by them
  const deep = view.possible() ? begin() : null;
  const coverage = api.coverage();
  for (const answer of [known, coverage]) answer.catch(() => null);
  $("busy").hidden = !deep;
  let first;
  try {
    const [{ versions }, manifest] = await known;
    if (starting !== known) return;
    Object.assign(state, { versions, manifest });
    fillRange();
    first = askRange(Boolean(deep));
    await firstPoints(deep);
    state.coverage = (await coverage).tiles;
  } catch (error) {
    return refuse(error);
  }
  $("notice").hidden = true;
  $("content").hidden = false;
  $("which-map").textContent = `${state.manifest.map_id}, version ${state.manifest.version}`;
  document.title = `mapvote: ${state.manifest.map_id}`;
  showVersions();
  showTiles();
  view.flat.fit(extent(view.tiles));
  await showRange(first);
  follow();
  showVehicles();
  openOnChanges(await showDesk());
  listen();
}
state.restart = () => start();

// The first look goes to what changed: what waits at the desk, else what the list holds. A link says itself where to look.
// It is read before the view writes its own place into the address.
const linked = address.read();
let opened = ["eye", "change", "cell", "pending"].some((name) => linked[name]);
// Who acts before everything has come looks where they chose.
for (const part of ["map", "cloud", "tools", "content"])
  for (const act of ["pointerdown", "click", "wheel", "keydown"])
    $(part).addEventListener(act, () => (opened = true), { capture: true, passive: true });
function openOnChanges(pending) {
  if (opened) return;
  opened = true;
  if (pending.length) return choose(pending[0], true);
  const large = state.features.filter((f) => f.properties.size !== "small");
  const boxes = (large.length ? large : state.features).map((f) => drawable(f).box);
  if (!boxes.length) return;
  const around = [0, 1].map((i) => Math.min(...boxes.map((b) => b[i]))).concat([2, 3].map((i) => Math.max(...boxes.map((b) => b[i]))));
  view.fit(around, 0.38, { elevation: 0.62 });
}

async function begin() {
  const coarse = api.overview().catch(() => null);
  return view.cloud ? coarse : view.begin(coarse).catch((error) => view.without(`3D does not start: ${error.message}`));
}

// The coarse picture, before anything else is asked for.
async function firstPoints(deep) {
  const buffer = await deep;
  $("busy").hidden = !buffer || !Object.keys(state.manifest.tiles).length;
  if (!buffer || !view.cloud) return;
  const { lattice, tiles } = state.manifest, { stream, cloud } = view;
  const box = extent(Object.keys(tiles).map((name) => {
    const [row, col] = name.split(",").map(Number);
    return { x: lattice.x0 + col * TILE, y: lattice.y0 + row * TILE };
  }));
  stream.place([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2, 0]);
  stream.setTiles(lattice, tiles, null);
  stream.overview(buffer);
  const eye = address.read().eye?.split(",").map(Number) ?? [];
  if (eye.length === 6 && eye.every(Number.isFinite)) cloud.orbit.state = eye;
  else view.fit(tight(stream.tiles) ?? box, 0, { at_once: true, elevation: 0.62 });
  view.placed = true;
  const { Tools } = await import("./tools.js");
  view.tools ??= new Tools(view, { setCompare: (on) => (state.paired = on) && showClouds() });
  stream.rest();
}

// The box of what there is, not of its tiles.
function tight(tiles) {
  let [x0, y0, x1, y1] = [Infinity, Infinity, -Infinity, -Infinity];
  for (const tile of tiles)
    for (const { packed } of tile.levels)
      for (let i = 0; i < packed.length; i += 44) {
        const [x, y] = [tile.x + (packed[i] * TILE) / 65535, tile.y + (packed[i + 1] * TILE) / 65535];
        [x0, y0, x1, y1] = [Math.min(x0, x), Math.min(y0, y), Math.max(x1, x), Math.max(y1, y)];
      }
  return x0 < x1 ? [x0, y0, x1, y1] : null;
}

function refuse(error) {
  $("busy").hidden = true;
  $("which-map").textContent = location.host;
  notice(error.message);
}

// ---- versions and the range between two of them

function showVersions() {
  const newest = state.manifest.version, shown = `${newest} ${state.versions.length}`;
  if ($("versions").dataset.shown === shown) return; // made anew, it would lose the focus and a question under way
  $("versions").dataset.shown = shown;
  const item = (v) =>
    element("li", {}, [
      element("div", { className: "head" }, [
        element("b", {}, [`Version ${v.number}`]),
        element("time", { title: v.created }, [when(v.created)]),
      ]),
      element("p", {}, [v.reason || "no reason given"]),
      element("p", { className: "by" }, [`${KIND[v.kind]?.(v) ?? v.kind} by ${v.published_by}`]),
      v.number > 1 && link("Show its changes", () => setRange(v.number - 1, v.number)),
      v.number !== newest && goingBack(v.number, newest),
    ]);
  $("versions").replaceChildren(...[...state.versions].reverse().map(item));
}

const KIND = {
  import: () => "imported",
  publish: () => "published",
  rollback: (v) => `rolled back to version ${v.target}`,
  replay: (v) => `replayed from version ${v.target}`,
};

// The difference is shown before anything happens; who may not do it is told so by the server.
function goingBack(number, newest) {
  const button = link("Go back to it", async () => {
    await setRange(newest, number);
    confirm(button, `Publish version ${number} again? The list shows what would change.`, () => goBack(number));
  });
  return button;
}

function fillRange() {
  const numbers = state.versions.map((v) => v.number);
  const options = () => numbers.map((n) => element("option", { value: n }, [String(n)]));
  $("from").replaceChildren(...options());
  $("to").replaceChildren(...options());
  const asked = address.read(), known = (n) => (numbers.includes(Number(n)) ? n : null);
  $("to").value = known(asked.to) ?? state.manifest.version;
  $("from").value = known(asked.from) ?? Math.max(numbers[0], state.manifest.version - 1);
}

function setRange(from, to) {
  $("from").value = from;
  $("to").value = to;
  return showRange();
}

// What the list and the cloud show of the two versions chosen, on its way.
function askRange(deep = Boolean(view.cloud)) {
  const [from, to] = [$("from").value, $("to").value];
  const same = from === to;
  const clouds = deep && !same ? api.cloudsChanged(from, to) : Promise.resolve(new ArrayBuffer(0));
  const list = same ? Promise.resolve({ features: [], numberMatched: 0 }) : api.changes(from, to);
  for (const answer of [list, clouds]) answer.catch(() => null);  // whoever shows it tells
  return (range = { from, to, list, clouds });
}

async function showRange(mine = askRange()) {
  const { from, to } = mine;
  closeDetails();
  const shown = showClouds();
  let found = { features: [], numberMatched: 0 };
  try {
    found = await mine.list;
  } catch (error) {
    refuse(error);
  }
  if (range !== mine) return;
  const usual = Number(to) === state.manifest.version && Number(from) === Math.max(state.versions[0].number, to - 1);
  address.write({ from: usual ? null : from, to: usual ? null : to });
  showList(found, nothing(from, to), { from, to });
  showLanelets();
  await shown;
}

// Two states of the map in 3D: the newer one, what came and went, and the older one if it is to be compared. They are
// the two versions of the range or, while a pending change is looked at, the newest version and what a publish would make.
async function showClouds(mine = range) {
  const { version, tiles, lattice } = state.manifest, { pending } = state;
  const of = async (number) => (Number(number) === version ? tiles : (await api.versionMap(number)).tiles);
  const [before, after] = pending ? [async () => tiles, async () => withTiles(tiles, pending.tiles)] : [() => of(mine.from), () => of(mine.to)];
  try {
    const [older, newer, changed] = await Promise.all([state.paired ? before() : null, after(), (pending ?? mine).clouds]);
    if (!view.cloud || range !== mine || state.pending !== pending) return;
    view.stream.setTiles(lattice, newer, older);
    view.stream.changes(changed, lattice, state.paired);
  } catch (error) {
    notice(error.message);
  }
}

state.showClouds = () => range && showClouds();

const withTiles = (tiles, made) => Object.fromEntries(Object.entries({ ...tiles, ...made }).filter(([, hashes]) => hashes));

const nothing = (from, to) =>
  state.versions.length < 2
    ? "There is only the first version. Changes appear once vehicles have voted and a version is published."
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
$("fit").onclick = () => (view.flat.fit(extent(view.tiles)), view.fit(tight(view.stream?.tiles ?? []) ?? extent(view.tiles), 0, { elevation: 0.62 }));
$("to-3d").onclick = () => view.show(view.mode === "deep" ? "flat" : "deep");
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.matches("input, select, textarea")) return;
  const keys = { 2: () => view.show("flat"), 3: () => view.show("deep"), 0: () => $("fit").click(), n: () => step(1), p: () => step(-1) };
  keys[event.key]?.();
});

// To the next change of the list, and there.
function step(by) {
  const rows = [...document.querySelectorAll("#changes button")];
  if (!rows.length) return;
  const at = rows.findIndex((row) => row.getAttribute("aria-current") === "true");
  const next = rows[(at + by + rows.length) % rows.length];
  next.focus();
  next.click();
}
$("from").onchange = $("to").onchange = () => showRange();
listenForLanelets();
for (const radio of document.getElementsByName("shade"))
  radio.onchange = () => ((state.shade = radio.value), address.write({ shade: radio.value === "seen" ? null : radio.value }), showTiles());
const shade = document.querySelector(`[name=shade][value="${CSS.escape(address.read().shade ?? "")}"]`);
if (shade) (shade.checked = true), (state.shade = shade.value);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => state.manifest && showTiles());
start();
