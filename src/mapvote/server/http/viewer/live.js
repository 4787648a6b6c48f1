// What happens on the server, as it happens: a stream of events, taken up again where it broke off.

import * as api from "./api.js";
import { showDesk } from "./desk.js";
import { $ } from "./dom.js";
import { state } from "./page.js";

const AGAIN_MS = [1000, 2000, 5000, 10_000];
let listening = false;

export async function listen() {
  if (listening) return;
  listening = true;
  for (let failed = 0; ; failed++) {
    try {
      const reader = (await api.stream()).pipeThrough(new TextDecoderStream()).getReader();
      $("offline").hidden = true;
      failed = 0;
      for (let text = ""; ; ) {
        const { value, done } = await reader.read();
        if (done) break;
        const pieces = (text + value).split("\n\n");
        text = pieces.pop();
        pieces.map(read).filter(Boolean).forEach(happened);
      }
    } catch (error) {
      if ([401, 403, 404].includes(error.status)) return void (listening = false);
    }
    $("offline").hidden = false;
    await new Promise((go) => setTimeout(go, AGAIN_MS[Math.min(failed, AGAIN_MS.length - 1)]));
  }
}

function read(piece) {
  const data = piece.split("\n").filter((line) => line.startsWith("data:")).map((line) => line.slice(5)).join("\n");
  try {
    return data ? JSON.parse(data) : null;
  } catch {
    return null;
  }
}

let waiting = null;

function happened(event) {
  $("news").textContent = `${event.kind}: ${event.detail} (${event.actor})`;
  clearTimeout(waiting);
  waiting = setTimeout(() => (event.version !== state.manifest.version ? state.restart?.() : showDesk()), 300);
}
