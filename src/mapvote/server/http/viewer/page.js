// What the panels share: what the server said, and the map's view.

export const state = { manifest: null, older: null, versions: [], coverage: [], features: [], shade: "seen", view: null };
