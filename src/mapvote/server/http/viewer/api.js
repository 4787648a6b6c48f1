// The server's answers. Every request goes to this server only; the key lives in this tab only.

const STORAGE = "mapvote-key";
const BASE = location.origin + location.pathname;  // without a user and password that the address may hold

export class Refused extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

export const key = {
  get: () => sessionStorage.getItem(STORAGE),
  set: (value) => sessionStorage.setItem(STORAGE, value),
  forget: () => sessionStorage.removeItem(STORAGE),
};

async function ask(path, parameters = {}) {
  const query = new URLSearchParams(parameters).toString();
  const headers = key.get() ? { Authorization: `Bearer ${key.get()}` } : {};
  let answer;
  try {
    answer = await fetch(`${BASE}v1/${path}${query ? "?" + query : ""}`, { headers });
  } catch {
    throw new Refused(0, "The server does not answer. Is it running?");
  }
  if (!answer.ok) throw new Refused(answer.status, await reason(answer));
  return answer;
}

async function reason(answer) {
  try {
    const body = await answer.json();
    return String(body.detail ?? body.error ?? answer.statusText);
  } catch {
    return `${answer.status} ${answer.statusText}`;
  }
}

export const manifest = async () => (await ask("map")).json();
export const versions = async () => (await ask("map/versions")).json();
export const changes = async (from, to) => (await ask("changes", { from, to })).json();
export const coverage = async () => (await ask("coverage")).json();
export const vehicles = async () => (await ask("vehicles")).json();
export const cell = async (x, y) => (await ask("cells", { x: x.toFixed(3), y: y.toFixed(3) })).json();

// (n, 3) points of a tile from its corner. The plane travels as zstd, which the browser undoes as a content encoding.
export async function points(hash) {
  const bytes = await (await ask(`tiles/${hash}`)).arrayBuffer();
  if (bytes.byteLength % 12) throw new Refused(0, "this browser cannot read compressed tiles");
  return new Float32Array(bytes);
}
