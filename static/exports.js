// Taking a session along: the server makes the file, its progress comes over the websocket, the browser saves it.

import { exportAddress, startExport, stopExport } from "./api.js";
import { byId, make, setText } from "./dom.js";
import { clockTime } from "./format.js";
import { popover } from "./popover.js";

const NAMES = {
  rrd: "Rerun recording", tum: "TUM trajectory", csv: "figures", parquet: "figures", png: "map",
  webm: "video", scene: "3-D scene", report: "report",
};
const ENDINGS = { scene: "scene.html", report: "report.html" };
const COPIED_MS = 1500;

export class Exports {
  #rows = new Map();
  #early = new Map(); // progress that came before the answer with the id

  constructor(state, timeline) {
    this.state = state;
    this.timeline = timeline;
    popover(byId("export-button"), byId("export-menu"), () => this.#sayStretch());
    state.watch(["session", "window"], () => this.#pointRerun());
    for (const button of document.querySelectorAll("[data-export]")) button.addEventListener("click", () => this.start(button.dataset.export));
    state.watch(["session", "windows"], () => (byId("export-button").disabled = !state.session || !state.windows));
  }

  /** The stretch of time a video shows: what is played again and again, else what the timeline shows. */
  #stretch() {
    const { loop, windows } = this.state;
    if (!loop) return { start: this.timeline.view.start, end: this.timeline.view.end };
    return { start: this.state.timeOf(loop.start), end: loop.end < windows ? this.state.timeOf(loop.end) : this.timeline.end };
  }

  #sayStretch() {
    const { start, end } = this.#stretch();
    setText(byId("export-stretch"), `.webm: ${clockTime(start)} to ${clockTime(end)}, ${this.state.loop ? "the loop" : "as the timeline shows"}`);
  }

  /** The link to rerun's viewer goes where the playhead is. */
  #pointRerun() {
    const { session, window } = this.state;
    const link = byId("export-rerun");
    if (!session) return void link.removeAttribute("href");
    link.href = `/rerun/?session=${encodeURIComponent(session)}&window=${window}`;
    setText(byId("export-rerun-window"), `at window ${window}, in a tab of its own`);
  }

  async start(to) {
    const session = this.state.session;
    const bar = make("progress", { max: 1, "aria-label": `${NAMES[to]} of ${session}` });
    const text = make("span", { class: "dim" }, "starting");
    const row = make("li", {}, make("span", {}, `${session}.${ENDINGS[to] ?? to}`), text, bar);
    byId("export-list").prepend(row);
    const { start, end } = this.#stretch();
    try {
      const id = await startExport(session, ["webm", "rrd"].includes(to) ? { to, start_s: start, end_s: end } : { to });
      const stop = make("button", { class: "plain", "aria-label": `Stop ${NAMES[to]} of ${session}`, on: { click: () => stopExport(id).catch((error) => this.#failed(this.#rows.get(id), error.message)) } }, "stop");
      row.append(stop);
      this.#rows.set(id, { row, bar, text, stop, to, saved: false });
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
    known.stop?.remove();
    known.text.replaceWith(link);
    known.row.firstChild.textContent = message.name ?? known.row.firstChild.textContent;
    if (known.to === "rrd") known.row.append(command(`rerun ${quoted(message.name)}`));
    link.click();
  }

  #failed({ row, bar, text, stop }, why) {
    bar.remove();
    stop?.remove();
    row.classList.add("failed");
    text.textContent = why;
  }
}

/** A file's name as a shell takes it. */
const quoted = (name) => (/^[\w.+-]+$/.test(name) ? name : `'${name.replaceAll("'", "'\\''")}'`);

/** A command that can be copied: rerun's viewer opens the file beside the page. */
function command(text) {
  const button = make("button", { class: "plain", title: "Copy the command that opens rerun's viewer, where the file was saved" }, "copy");
  button.addEventListener("click", async () => {
    await navigator.clipboard.writeText(text);
    setText(button, "copied");
    setTimeout(() => setText(button, "copy"), COPIED_MS);
  });
  return make("div", { class: "export-command" }, make("code", {}, text), button);
}
