// Small pieces of page. Text from the server is only ever text, never markup.

export const $ = (id) => document.getElementById(id);

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

export function notice(text, empty = false) {
  $("notice").textContent = text;
  $("notice").className = empty ? "empty" : "";
  $("notice").hidden = false;
}
