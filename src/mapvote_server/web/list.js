// The changes between two versions: what is large first, what is small folded away.

import { drawable, nameOf, showChange, visit } from "./details.js";
import { $, address, dot, element, refill, state } from "./page.js";

const MOST_IN_A_FILE = 10_000;  // as many as the server sends at once
const FOLDS = { vehicle: ["vehicles-maybe", (n) => `${n} that could be ${n > 1 ? "vehicles" : "a vehicle"}`], small: ["small", (n) => `${n} smaller than 1 m\u00b2`] };

export function showList({ features, numberMatched }, nothing, range) {
  state.features = [...features].sort((a, b) => b.properties.area_m2 - a.properties.area_m2);
  state.view.setChanges(state.features.map(drawable));
  const large = state.features.filter((f) => !(f.properties.size in FOLDS));
  const count = (kind) => large.filter((f) => f.properties.kind === kind).length;
  $("tally").replaceChildren(
    ...(features.length
      ? [dot("built"), `${count("built")} built `, " \u2002 ", dot("demolished"), `${count("demolished")} demolished`]
      : [element("span", { className: "hint" }, [nothing])]),
    ...(numberMatched > features.length
      ? [element("span", { className: "hint" }, [` among the largest ${features.length} of ${numberMatched} changes`])]
      : []),
  );
  refill($("changes"), large.map(row));
  for (const [size, [id, told]] of Object.entries(FOLDS)) {
    const some = state.features.filter((f) => f.properties.size === size);
    $(id).hidden = !some.length;
    $(id).querySelector("summary").textContent = told(some.length);
    refill($(id).querySelector("ol"), some.map(row));
    $(id).open = unfolded().includes(size);
    $(id).ontoggle = () => unfold(size, $(id).open);
  }
  for (const format of ["geojson", "csv"]) {
    $(`as-${format}`).href = `v1/changes?${new URLSearchParams({ ...range, format, limit: MOST_IN_A_FILE })}`;
  }
}

const unfolded = () => address.read().open?.split(",") ?? [];

function unfold(size, open) {
  const sizes = unfolded().filter((other) => other !== size).concat(open ? size : []);
  address.write({ open: sizes.join() || null });
  address.flush();  // the next one unfolded is written beside it
}

const row = (f) =>
  element("li", { id: `item-${f.id}` }, [
    element("button", { onclick: () => (showChange(f.id), visit(f)) }, [
      dot(f.properties.kind),
      nameOf(f.properties),
      element("span", { className: "number" }, [`${f.properties.area_m2.toFixed(1)} m\u00b2`]),
      element("span", { className: "number" }, [`${f.properties.height_m.toFixed(1)} m high`]),
    ]),
  ]);
