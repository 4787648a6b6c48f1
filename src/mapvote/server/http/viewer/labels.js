// Signs over the large changes: what happened is told by word and sign, not by colour alone.

const MOST = 24;

export class Labels {
  constructor(home, onChosen) {
    Object.assign(this, { home, onChosen, signs: [] });
  }

  set(changes) {
    const large = changes.filter((c) => c.size === "large" || c.pending).slice(0, MOST);
    this.signs = large.map((change) => {
      const sign = document.createElement("button");
      sign.type = "button";
      sign.tabIndex = -1;  // the list beside it holds the same, in order, for the keyboard
      sign.className = `sign ${change.kind}`;
      sign.textContent = `${change.pending ? "waits: " : ""}${change.kind === "built" ? "+ built" : "\u00d7 demolished"}${change.height ? ` ${change.height.toFixed(0)} m` : ""}`;
      sign.onclick = () => this.onChosen(change.id);
      return { change, sign };
    });
    this.home.replaceChildren(...this.signs.map((s) => s.sign));
  }

  select(id) {
    for (const { change, sign } of this.signs) sign.classList.toggle("chosen", change.id === id);
  }

  place(cloud, groundAt) {
    const taken = [];
    const [w, h] = [cloud.canvas.clientWidth, cloud.canvas.clientHeight];
    for (const { change, sign } of this.signs) {
      const [x0, y0, x1, y1] = change.box;
      const at = cloud.project([(x0 + x1) / 2, (y0 + y1) / 2, groundAt(change.box) + (change.height ?? 4) + 1.5]);
      const out = !at || at[0] < 0 || at[1] < 0 || at[0] > w || at[1] > h;
      const crowded = !out && taken.some((o) => Math.abs(o[0] - at[0]) < 110 && Math.abs(o[1] - at[1]) < 22);
      sign.hidden = out || crowded;
      if (sign.hidden) continue;
      taken.push(at);
      sign.style.transform = `translate(${at[0]}px, ${at[1]}px) translate(-50%, -100%)`;
    }
  }
}
