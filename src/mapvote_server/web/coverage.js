// Which tiles there are, and when and by how many vehicles they were seen.

import { TILE } from "./view.js";
import { $, element, notice, state } from "./page.js";

const DAY = 86400e3;
const SHADES = {
  seen: { of: (t) => seenStep(t.last_seen), labels: ["1 day", "1 week", "1 month", "older", "never"] },
  vehicles: { of: (t) => vehicleStep(t.vehicles), labels: ["9+", "4-8", "2-3", "1", "0"] },
  none: { of: () => 4, labels: [] },
};
const STRENGTH = [0.42, 0.28, 0.17, 0.09, 0];  // opacity, from fresh to never

export function showTiles() {
  const shade = SHADES[state.shade], rgb = getComputedStyle(document.documentElement).getPropertyValue("--shade");
  const { x0, y0 } = state.manifest.lattice;
  const known = new Map();
  for (const [name, tile] of Object.entries(state.manifest.tiles))
    known.set(name, { hash: tile.points, last_seen: null, vehicles: 0 });
  for (const t of state.coverage) known.set(`${t.row},${t.col}`, { ...known.get(`${t.row},${t.col}`), ...t });
  const fill = (step) => `rgba(${rgb}, ${STRENGTH[step]})`;
  state.view.setTiles(
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
    ? "No ballot has come yet."
    : `${known.size - unseen} of ${known.size} tiles (76.8 m) seen by a vehicle.`;
  if (!known.size) notice("This map has no tiles yet.", true);
}

function seenStep(stamp) {
  if (!stamp) return 4;
  const age = Date.now() - Date.parse(stamp);
  return age <= DAY ? 0 : age <= 7 * DAY ? 1 : age <= 31 * DAY ? 2 : 3;
}

const vehicleStep = (n) => (n >= 9 ? 0 : n >= 4 ? 1 : n >= 2 ? 2 : n >= 1 ? 3 : 4);
