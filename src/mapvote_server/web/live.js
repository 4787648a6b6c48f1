// What happens on the server, as it happens: a stream of events, taken up again where it broke off.

import * as api from "./api.js";
import { showDesk } from "./desk.js";
import { $, state } from "./page.js";

const AGAIN_MS = [1000, 2000, 5000, 10_000];
let listening = false;

export async function listen() {
  if (listening) return;
  listening = true;
  for (let failed = 0; ; failed++) {
    try {
      for await (const event of api.events()) {
        $("offline").hidden = true;
        failed = 0;
        if (event) happened(event);
      }
    } catch (error) {
      if ([401, 403, 404].includes(error.status)) return void (listening = false);
    }
    $("offline").hidden = false;
    await new Promise((go) => setTimeout(go, AGAIN_MS[Math.min(failed, AGAIN_MS.length - 1)]));
  }
}

let waiting = null;

function happened(event) {
  $("news").textContent = `${event.kind}: ${event.detail} (${event.actor})`;
  clearTimeout(waiting);
  waiting = setTimeout(() => (event.version !== state.manifest.version ? state.restart?.() : showDesk()), 300);
}
