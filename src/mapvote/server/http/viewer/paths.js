// Where the vehicles drove whose votes stand: lines in both pictures. The server tells reviewers and operators only.

import * as api from "./api.js";
import { $, notice } from "./dom.js";
import * as address from "./link.js";
import { state } from "./page.js";

const GAP_M = 40;  // farther apart: the vehicle did not know where it was in between

export async function showPaths() {
  const asked = $("paths").checked;
  address.write({ paths: asked ? "1" : null });
  if (!asked) return draw([]);
  try {
    const features = (await api.paths()).features;
    if ($("paths").checked) draw(features);
  } catch (error) {
    notice(error.message);
  }
}

// Once the server has told that it tells: as the address says, and up to date with each new ballot.
export function offerPaths() {
  $("paths-row").hidden = false;
  if (address.read().paths === "1") $("paths").checked = true;
  if ($("paths").checked) showPaths();
}

function draw(features) {
  const km = features.reduce((sum, f) => sum + f.properties.length_m, 0) / 1000;
  $("paths-text").textContent = !$("paths").checked ? "" : features.length ? `${features.length} drives, ${km.toFixed(1)} km` : "no ballot tells of its path";
  const lines = features.flatMap((f) => unbroken(f.geometry.coordinates));
  state.view.setPaths(lines);
}

function unbroken(line) {
  const parts = [[]];
  for (const at of line) {
    const last = parts.at(-1).at(-1);
    if (last && Math.hypot(at[0] - last[0], at[1] - last[1]) > GAP_M) parts.push([]);
    parts.at(-1).push(at);
  }
  return parts.filter((part) => part.length > 1);
}

$("paths").onchange = showPaths;
