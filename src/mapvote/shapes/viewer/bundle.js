// Modules that lie in the page become modules: each gets an address of its own, which those that import it are told.
const sources = JSON.parse(document.getElementById("modules").textContent), made = {};
for (const [name, source] of Object.entries(sources)) {
  const text = source.replace(/(from\s*)"\.\/([^"]+)"/g, (whole, from, other) => {
    const known = made[other] ?? made[`vendor/${other}`];
    return known ? `${from}"${known}"` : whole;
  });
  made[name] = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
}
import(made["standalone.js"]);
