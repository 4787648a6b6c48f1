// Everything one sees is in the address: sending it on shows the same.

const ORDER = ["change", "cell", "from", "to", "view", "shade", "colour", "vehicle", "compare", "swipe", "slice", "paths", "open", "pending", "eye"];

export function read() {
  const found = new URLSearchParams(location.hash.slice(1));
  return Object.fromEntries(ORDER.filter((name) => found.has(name)).map((name) => [name, found.get(name)]));
}

let waiting = null;
const next = {};

// Values to set; null takes one away. Written once things have settled, never into the history.
export function write(values) {
  Object.assign(next, values);
  clearTimeout(waiting);
  waiting = setTimeout(flush, 120);
}

export function flush() {
  clearTimeout(waiting);
  const all = { ...read(), ...next };
  for (const name of Object.keys(next)) delete next[name];
  const parts = ORDER.filter((name) => all[name] !== undefined && all[name] !== null);
  const plain = (value) => encodeURIComponent(value).replaceAll("%2C", ",");
  history.replaceState(null, "", "#" + parts.map((name) => `${name}=${plain(all[name])}`).join("&"));
}
