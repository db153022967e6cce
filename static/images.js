// The images of a window: decoded in a worker, only the latest painted, sharp to the pixel.

import { byId, make, setText } from "./dom.js";
import { fixed, whole } from "./format.js";

export const KINDS = [
  { kind: "raw", name: "raw", title: "The window's events as they were recorded, undistorted", note: (v) => `${whole(v.events)} events` },
  { kind: "warped", name: "warped", title: "The same events moved back along the estimated velocity: sharp where it is right", note: (v) => `contrast ×${fixed(v.contrast_after / v.contrast_before)}` },
  { kind: "map", name: "on map", title: "The warped window on the newest map seen from its refined pose: edges that the map explains, and those that it does not", note: () => "" },
  { kind: "texture", name: "texture", title: "The map as it was at this window", note: () => "" },
];

/** Why an image is missing; the note is said once, under raw. */
function why(kind, note) {
  if (kind === "raw") return note || "no events";
  if (kind === "warped") return note ? "stored for keyframes only" : "no events";
  return note && kind === "map" ? "needs the events" : "no map yet";
}

export class Images {
  #worker = new Worker("/static/decoder.js");
  #cells = new Map();
  #busy = null; // message in the worker
  #next = null; // the newest that waits: older ones are dropped, never queued
  #painted = -1;

  /** `shown(message)` is called after the images of a message are on their canvases. */
  constructor(shown) {
    this.shown = shown;
    this.large = null;
    this.#worker.onmessage = ({ data }) => this.#decoded(data);
    byId("images").replaceChildren(...KINDS.map((kind, i) => this.#cell(kind, i)));
    new ResizeObserver(() => this.#fit()).observe(byId("images"));
  }

  #cell({ kind, name, title }, i) {
    const canvas = make("canvas", { width: 4, height: 3, role: "img", "aria-label": `${name}: ${title}` });
    const note = make("span", { class: "dim number" });
    const missing = make("span", { class: "missing dim" });
    const legend = kind === "map" ? make("span", { class: "edge-legend" }, make("i", { class: "explained" }), "explained", make("i", { class: "unexplained" }), "new") : null;
    const figure = make(
      "button",
      { class: "cell", dataset: { kind }, "aria-pressed": "false", title: `${title} (${i + 1}: enlarge)`, on: { click: () => this.enlarge(kind) } },
      make("span", { class: "caption" }, make("b", {}, name), legend, make("span", { class: "spring" }), note),
      make("span", { class: "picture" }, canvas, missing),
    );
    this.#cells.set(kind, { figure, canvas, note, missing, pen: canvas.getContext("2d") });
    return figure;
  }

  /** One image over the whole place, or all four again. */
  enlarge(kind) {
    this.large = this.large === kind ? null : kind;
    byId("images").dataset.large = this.large ?? "";
    for (const [name, { figure }] of this.#cells) {
      figure.hidden = this.large !== null && this.large !== name;
      figure.setAttribute("aria-pressed", String(this.large === name));
    }
    this.#fit();
  }

  /** Takes an `images` message. */
  take(message) {
    if (message.request < this.#painted) return;
    this.#next = message;
    this.#feed();
  }

  /** Nothing is shown; what comes late belongs to another session. */
  clear(why = "") {
    this.#next = null;
    this.#painted = Infinity;
    this.blank(why);
  }

  /** Says in the place of the images why there are none. */
  blank(why) {
    for (const cell of this.#cells.values()) this.#blank(cell, why);
  }

  /** Images with this request number or a later one may be painted again. */
  accept(request) {
    this.#painted = request - 1;
  }

  #feed() {
    if (this.#busy || !this.#next) return;
    const message = (this.#busy = this.#next);
    this.#next = null;
    const images = message.images.map(({ data, mime }) => ({ data, mime }));
    this.#worker.postMessage({ job: message.request, images }, images.map(({ data }) => data));
  }

  #decoded({ job, bitmaps, error }) {
    const message = this.#busy;
    this.#busy = null;
    this.#feed();
    if (error) console.error(`images of window ${message.window}: ${error}`);
    if (!error && job >= this.#painted) {
      this.#painted = job;
      this.#paint(message, bitmaps);
      this.shown(message);
    }
    for (const bitmap of bitmaps) bitmap.close();
  }

  #paint({ images, values, window }, bitmaps) {
    for (const { kind, name, note } of KINDS) {
      if (this.large !== null && this.large !== kind) continue;
      const cell = this.#cells.get(kind);
      const i = images.findIndex((image) => image.kind === kind);
      setText(cell.note, values ? note(values) : "");
      if (i < 0) {
        this.#blank(cell, why(kind, values?.note));
        continue;
      }
      const { width, height } = bitmaps[i];
      if (cell.canvas.width !== width || cell.canvas.height !== height) {
        [cell.canvas.width, cell.canvas.height] = [width, height];
        if (kind === "raw") byId("images").style.setProperty("--aspect", `${width} / ${height}`);
        this.#fit(cell);
      }
      cell.pen.drawImage(bitmaps[i], 0, 0);
      cell.canvas.dataset.window = window;
      cell.canvas.hidden = false;
      cell.missing.hidden = true;
      cell.canvas.setAttribute("aria-label", `${name}, window ${window}`);
    }
  }

  #blank(cell, why) {
    cell.canvas.hidden = true;
    delete cell.canvas.dataset.window;
    cell.missing.hidden = false;
    setText(cell.missing, why);
  }

  /** Enlarged pixels stay squares; where pixels are made smaller they are averaged, or single events would vanish. */
  #fit(only = null) {
    for (const cell of only ? [only] : this.#cells.values()) {
      const box = cell.canvas.parentElement.getBoundingClientRect();
      const scale = Math.min(box.width / cell.canvas.width, box.height / cell.canvas.height) * devicePixelRatio;
      cell.canvas.classList.toggle("pixels", scale >= 1);
    }
  }
}
