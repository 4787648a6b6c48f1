// The desk: what a publish would change now, judged one by one; publishing and going back, the difference shown first.

import * as api from "./api.js";
import { drawable, nameOf, sides } from "./details.js";
import { $, address, dot, element, notice, refill, state } from "./page.js";

const SAID = { accepted: "accepted", held: "held", rejected: "rejected" };
const KEYS = { a: "accepted", h: "held", r: "rejected" };
const REVIEW = "verdict.";  // a change that was held or rejected, which a publish leaves out
let desk = null, chosen = null;
let asking = null;  // the newest question about the desk: an older answer may come later
let moving = null;  // the change whose verdict is on its way: the desk moves on after it, unless somebody chose meanwhile

// For reviewers and operators; to anyone else the server does not tell. The pending changes, the largest first.
export async function showDesk() {
  const mine = (asking = api.desk());
  let answer;
  try {
    answer = await mine;
  } catch (error) {
    if (error.status !== 403) notice(error.message);
    return [];
  }
  const pending = largestFirst(answer.pending.features);
  if (asking === mine) show((desk = answer), pending);
  return pending;
}

const largestFirst = (features) => [...features].sort((a, b) => b.properties.area_m2 - a.properties.area_m2);

function show({ reviewed, held, doubts, version, waits, waiting }, pending) {
  $("desk").hidden = false;
  $("desk-tally").textContent = pending.length
    ? `A publish would make ${pending.length} change${pending.length > 1 ? "s" : ""} to version ${version}.`
    : `No change is pending: a publish would leave version ${version} as it is.${waits ? ` ${waits}.` : ""}`;
  const told = [...held.map((reason) => `The policy would hold it: ${reason}`), ...doubts.map((text) => `Look: ${text}`)];
  $("desk-held").replaceChildren(...told.map((text) => element("li", {}, [text])));
  refill($("pending"), [...pending, ...reviewed].map(row));
  $("waiting-tally").textContent = waiting.length ? "Not deleted yet: the risk of deleting something that stands is above the policy's budget. A vehicle should drive by." : "";
  refill($("waiting"), largestFirst(waiting).map(left));
  $("publish").disabled = !pending.length;
  $("publish").textContent = held.length ? "Publish and override" : "Publish";
  const wanted = chosen?.id ?? address.read().pending;
  choose([...pending, ...reviewed].find((f) => f.id === wanted) ?? null);
}

const row = (f) => {
  const p = f.properties, v = p.verdict;
  const button = element("button", { onclick: () => go(f) }, [
    dot(p.kind),
    nameOf(p),
    element("span", { className: "number" }, [`${p.area_m2.toFixed(1)} m\u00b2`]),
    element("span", { className: "number" }, [v ? `${SAID[v.verdict]} by ${v.by}` : `${p.votes_median} of ${p.votes_median + p.against_median} votes`]),
  ]);
  button.dataset.change = f.id;
  return element("li", {}, [button]);
};

// What is beyond the policy's budget of false deletions: to look at, not to decide about.
const left = (f) => {
  const { kind, area_m2: area, false_deletion: risk, drive_by: [x, y], waits } = f.properties;
  const look = () => {
    go(null);
    const shown = drawable(f);
    state.view.setPending(shown);
    state.view.fit(shown.box, 0.38, { elevation: 0.5, height: shown.height });
    $("difference").textContent = `Not deleted: ${waits}. A vehicle should drive by x ${x.toFixed(1)}, y ${y.toFixed(1)}.`;
  };
  return element("li", {}, [
    element("button", { title: waits, onclick: look }, [
      dot(kind),
      "Not deleted",
      element("span", { className: "number" }, [`${area.toFixed(1)} m\u00b2`]),
      element("span", { className: "number" }, [`risk ${(100 * risk).toPrecision(2)} %`]),
    ]),
  ]);
};

// Somebody's own choice: no verdict that is on its way moves on from it.
function go(feature) {
  moving = null;
  choose(feature, Boolean(feature));
}

export function choose(feature, visit = false) {
  chosen = feature;
  address.write({ pending: feature?.id ?? null });
  state.view.setPending(feature && drawable(feature));
  inClouds(feature);
  for (const button of $("pending").querySelectorAll("button")) button.setAttribute("aria-current", String(button.dataset.change === feature?.id));
  $("verdict-form").hidden = !feature;
  if (!feature) return;
  const v = feature.properties.verdict, shown = drawable(feature);
  $("verdict-told").textContent = v ? `${v.by} ${SAID[v.verdict]} it${v.comment ? `: \u201c${v.comment}\u201d` : "."}` : "No verdict yet.";
  $("undo").disabled = !v;
  if (visit) state.view.fit(shown.box, 0.38, { elevation: 0.5, height: shown.height });
}

// In 3D as a publish would make the map, as long as one of its changes is looked at.
function inClouds(feature) {
  const would = Boolean(feature && !feature.id.startsWith(REVIEW) && state.view.cloud);
  refill($("pending-sides"), would ? [sides()] : []);
  if (!would && !state.pending) return;
  if (would) desk.clouds ??= api.cloudsPending();
  state.pending = would ? desk : null;
  state.showClouds?.();
}

function decide(verdict) {
  const next = chosen && nextAfter(chosen.id);
  return judge(async ({ id: change, properties }) => {
    await api.review({ change, verdict, comment: $("comment").value, after: properties.verdict?.seq ?? null });
    $("comment").value = "";
    return next ? { id: next } : null;
  });
}

const undo = () => judge(async (f) => (await api.takeBack(f.properties.verdict.seq), null));

// Judges the change that is chosen, and moves on to what the judgement returns. A key pressed twice judges once, and
// nothing is judged before it is shown: until then only its id is known.
async function judge(judgement) {
  if (!chosen?.properties || moving?.id === chosen.id) return;
  const mine = (moving = chosen);
  await told(async () => {
    try {
      const next = await judgement(mine);
      if (moving === mine) chosen = next;
    } finally {
      if (moving === mine) moving = null;
    }
  });
}

const nextAfter = (id) => {
  const ids = [...$("pending").querySelectorAll("button")].map((b) => b.dataset.change);
  return ids[ids.indexOf(id) + 1] ?? null;
};

// Does it, says what came of it, and looks at the desk again: somebody else may have decided meanwhile.
async function told(action, done = "") {
  try {
    await action();
    $("desk-said").textContent = done;
  } catch (error) {
    $("desk-said").textContent = error.message;
  }
  await showDesk();
}

$("verdict-form").onsubmit = (event) => event.preventDefault();
for (const [key, verdict] of Object.entries(KEYS)) $(verdict).onclick = () => decide(verdict);
$("undo").onclick = undo;
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.matches("input, select, textarea")) return;
  if ($("desk").hidden || !chosen) return;
  if (event.key in KEYS) decide(KEYS[event.key]);
  else if (event.key === "u" && !$("undo").disabled) $("undo").click();
});

$("dry-run").onclick = () => told(async () => {
  const would = await api.publish({ dry_run: true });
  $("difference").textContent = `It would change ${would.tiles.length} tiles: ${would.points_added} points added, ${would.points_deleted} deleted.`;
});
$("publish").onclick = () => confirm($("publish"), `${$("publish").textContent}: ${desk.pending.features.length} changes?`, async () => {
  await told(async () => {
    const watch = setInterval(watched, 500);
    $("cancel").hidden = false;
    $("desk-said").textContent = "Publishing\u2026";
    const asked = { parent: desk.version, override: desk.held.length > 0, reason: $("reason").value };
    const done = await api.publish(asked).finally(() => (clearInterval(watch), ($("cancel").hidden = true)));
    $("difference").textContent = `Version ${done.version} is published: ${done.points_added} points added, ${done.points_deleted} deleted.`;
  });
  state.restart?.();
});

// How far it is, while it lasts.
async function watched() {
  const mine = (await api.publishing().catch(() => [])).find((one) => !one.dry_run);
  if (mine && !$("cancel").hidden) $("desk-said").textContent = `Publishing: ${mine.done} of ${mine.of} tiles`;
}
$("cancel").onclick = () => api.cancelPublish().catch((error) => notice(error.message));

// A button that asks once more, in its own place, before it acts.
export function confirm(button, question, action) {
  const usual = button.textContent;
  if (button.dataset.asked) return;
  button.dataset.asked = "yes";
  const yes = element("button", { type: "button", className: "yes" }, [question]);
  const no = element("button", { type: "button" }, ["Cancel"]);
  const end = () => (yes.remove(), no.remove(), (button.hidden = false), delete button.dataset.asked, (button.textContent = usual));
  yes.onclick = () => (end(), action());
  no.onclick = () => (end(), button.focus());
  button.hidden = true;
  button.after(yes, no);
  yes.focus();
}

export async function goBack(number) {
  await told(async () => {
    const done = await api.rollback({ to: number, reason: $("reason").value });
    $("difference").textContent = `Version ${done.version} is version ${number} again.`;
  });
  state.restart?.();
}
