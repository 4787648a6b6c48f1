// What the panels share: the page's state, its address, and small pieces of page.

export const state = { manifest: null, versions: [], coverage: [], features: [], shade: "seen", view: null, pending: null };

export const $ = (id) => document.getElementById(id);

// Text from the server is only ever text, never markup.
export function element(tag, properties, children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children.filter(Boolean));
  return made;
}

export const dot = (kind) => element("span", { className: `dot ${kind}` }, []);
export const link = (text, onclick) => element("button", { className: "link", type: "button", onclick }, [text]);
export const facts = (pairs) => element("dl", {}, pairs.filter(Boolean).flatMap(([k, v]) => [element("dt", {}, [k]), element("dd", {}, [v])]));
export const number = (n) => (Number.isInteger(n) ? String(n) : n.toFixed(1));
export const when = (stamp) => (stamp ? stamp.slice(0, 16).replace("T", " ") + " UTC" : "unknown");

// A list made anew while somebody is in it: the focus stays on the row that is about the same thing, else in its place.
export function refill(list, rows) {
  const about = (button) => button.dataset.change ?? (button.value || button.textContent);
  const focused = document.activeElement;
  const place = [...list.querySelectorAll("button")].indexOf(focused);
  list.replaceChildren(...rows);
  if (place < 0) return;
  const buttons = [...list.querySelectorAll("button")];
  (buttons.find((b) => about(b) === about(focused)) ?? buttons[place])?.focus();
}

export function notice(text, empty = false) {
  $("notice").textContent = text;
  $("notice").className = empty ? "empty" : "";
  $("notice").hidden = false;
}

// The address holds everything that is shown: whoever opens it sees the same.
const ORDER = ["change", "cell", "from", "to", "view", "shade", "colour", "vehicle", "compare", "swipe", "slice", "paths", "next", "open", "pending", "eye"];
const next = {};
let waiting = null;

export const address = {
  read() {
    const found = new URLSearchParams(location.hash.slice(1));
    return Object.fromEntries(ORDER.filter((name) => found.has(name)).map((name) => [name, found.get(name)]));
  },

  // Values to set; null takes one away. Written once no other comes for a moment, never into the history.
  write(values) {
    Object.assign(next, values);
    clearTimeout(waiting);
    waiting = setTimeout(address.flush, 120);
  },

  flush() {
    clearTimeout(waiting);
    const all = { ...address.read(), ...next };
    for (const name of Object.keys(next)) delete next[name];
    const parts = ORDER.filter((name) => all[name] !== undefined && all[name] !== null);
    const plain = (value) => encodeURIComponent(value).replaceAll("%2C", ",");
    history.replaceState(null, "", "#" + parts.map((name) => `${name}=${plain(all[name])}`).join("&"));
  },
};
