// Taking a session along: the server makes the file, its progress comes over the websocket, the browser saves it.

import { exportAddress, startExport } from "./api.js";
import { byId, make, setText } from "./dom.js";
import { popover } from "./popover.js";

const NAMES = { rrd: "Rerun recording", tum: "TUM trajectory", csv: "figures", png: "map" };

export class Exports {
  #rows = new Map();
  #early = new Map(); // progress that came before the answer with the id

  constructor(state) {
    this.state = state;
    popover(byId("export-button"), byId("export-menu"));
    for (const button of document.querySelectorAll("[data-export]")) button.addEventListener("click", () => this.start(button.dataset.export));
    state.watch(["session", "windows"], () => (byId("export-button").disabled = !state.session || !state.windows));
  }

  async start(to) {
    const session = this.state.session;
    const bar = make("progress", { max: 1, "aria-label": `${NAMES[to]} of ${session}` });
    const text = make("span", { class: "dim" }, "starting");
    const row = make("li", {}, make("span", {}, `${session}.${to}`), text, bar);
    byId("export-list").prepend(row);
    try {
      const id = await startExport(session, to);
      this.#rows.set(id, { row, bar, text, saved: false });
      if (this.#early.has(id)) this.take(this.#early.get(id));
    } catch (error) {
      this.#failed({ row, bar, text }, error.message);
    }
  }

  /** Takes an `export` message. */
  take(message) {
    const known = this.#rows.get(message.id);
    if (!known) return void this.#early.set(message.id, message);
    if (message.error) return this.#failed(known, message.error);
    known.bar.value = message.share ?? 0;
    setText(known.text, `${Math.round(100 * (message.share ?? 0))} %`);
    if (!message.done || known.saved) return;
    known.saved = true;
    const link = make("a", { href: exportAddress(message.id), download: message.name ?? "" }, "save again");
    known.bar.remove();
    known.text.replaceWith(link);
    known.row.firstChild.textContent = message.name ?? known.row.firstChild.textContent;
    link.click();
  }

  #failed({ row, bar, text }, why) {
    bar.remove();
    row.classList.add("failed");
    text.textContent = why;
  }
}
