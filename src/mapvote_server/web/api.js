// The server's answers. Every request goes to this server only; the browser sends the key that it was given for it.

const BASE = location.origin + location.pathname;  // without a user and password that the address may hold

export class Refused extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

async function ask(path, parameters = {}, more = {}) {
  const query = new URLSearchParams(parameters).toString();
  let answer;
  try {
    answer = await fetch(`${BASE}v1/${path}${query ? "?" + query : ""}`, more);
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
export const lanelets = async (from, to, body) =>
  (await ask("changes/lanelets", { from, to }, { method: "POST", headers: { "Content-Type": "application/xml" }, body })).json();
export const coverage = async () => (await ask("coverage")).json();
export const vehicles = async () => (await ask("vehicles")).json();
export const overview = async (version) => (await ask("clouds/overview", version ? { version } : {})).arrayBuffer();
export const cloudPart = async ({ points, ground, fields }, level) =>
  (await ask(`clouds/${points}/${ground}/${level}`, fields ? { fields } : {})).arrayBuffer();
export const evidence = async (tile, vehicle) => (await ask(`evidence/${tile.replace(",", "/")}`, vehicle ? { vehicle } : {})).arrayBuffer();
export const passes = async () => (await ask("coverage/passes")).json();
export const paths = async (vehicle) => (await ask("paths", vehicle ? { vehicle } : {})).json();
export const versionMap = async (number) => (await ask(`map/versions/${number}`)).json();
export const cloudsChanged = async (from, to) => (await ask("clouds/changed", { from, to })).arrayBuffer();
export const cloudsPending = async () => (await ask("desk/clouds")).arrayBuffer();

const send = async (path, method, body) =>
  (await ask(path, {}, { method, headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) })).json();
export const desk = async () => (await ask("desk")).json();
export const review = (asked) => send("desk/reviews", "POST", asked);
export const takeBack = (seq) => send(`desk/reviews/${seq}`, "DELETE", undefined);
export const publish = (asked) => send("publish", "POST", asked);
export const publishing = async () => (await (await ask("publish")).json()).running;
export const cancelPublish = () => send("publish", "DELETE", undefined);
export const rollback = (asked) => send("rollback", "POST", asked);

// Events as they happen, until the connection ends; before the first one null, once the server answers.
export async function* events() {
  const reader = (await ask("events")).body.pipeThrough(new TextDecoderStream()).getReader();
  yield null;
  for (let text = ""; ; ) {
    const { value, done } = await reader.read();
    if (done) return;
    const pieces = (text + value).split("\n\n");
    text = pieces.pop();
    yield* pieces.map(parsed).filter(Boolean);
  }
}

function parsed(piece) {
  const data = piece.split("\n").filter((line) => line.startsWith("data:")).map((line) => line.slice(5)).join("\n");
  try {
    return data ? JSON.parse(data) : null;
  } catch {
    return null;
  }
}

export const cell = async (x, y) => (await ask("cells", { x: x.toFixed(3), y: y.toFixed(3) })).json();

// (n, 3) points of a tile from its corner. The plane travels as zstd, which the browser undoes as a content encoding.
export async function points(hash) {
  const bytes = await (await ask(`tiles/${hash}`)).arrayBuffer();
  if (bytes.byteLength % 12) throw new Refused(0, "this browser cannot read compressed tiles");
  return new Float32Array(bytes);
}
