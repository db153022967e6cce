// The images of a window: decoded in a worker, only the latest painted, sharp to the pixel.

import { byId, make, setText } from "./dom.js";
import { fixed, percent, whole } from "./format.js";

/** What can be shown of a window, in the order in which it stands on the page. */
export const KINDS = [
  { kind: "raw", name: "raw", title: "The window's events as they were recorded, undistorted", note: (v) => `${whole(v.events)} events` },
  { kind: "warped", name: "warped", title: "The same events moved back along the estimated motion: sharp where it is right", note: (v) => `×${fixed(v.contrast_after / v.contrast_before)}` },
  { kind: "map", name: "on map", title: "The warped window on the newest map seen from its refined pose: edges that the map explains, and those that it does not", note: () => "", edges: true },
  { kind: "residual", name: "residual", title: "The window on the map of that moment, from the pose of that moment: what the map explains is dim, what is left over is bright", note: (v) => (Number.isFinite(v.overlap) ? `${percent(v.overlap)} explained` : ""), edges: true },
  { kind: "truth", name: "true motion", title: "The events moved back along the ground-truth motion: where this is sharper than “warped”, the estimated motion is wrong", note: () => "", truth: true },
  { kind: "aligned", name: "true pose on map", title: "The window on the newest map seen from the ground-truth pose, aligned: where this fits better than “on map”, the estimated pose is wrong; where it does not, the map is", note: () => "", edges: true, truth: true },
  { kind: "texture", name: "texture", title: "The map as it was at this window", note: () => "" },
];
const FIRST_CHOICE = ["raw", "warped", "map", "texture"];

/** Why an image is missing; the note is said once, under raw. */
function why({ kind, edges, truth }, values) {
  const note = values?.note;
  if (kind === "raw") return note || "no events";
  if (kind === "warped") return note ? "stored for keyframes only" : "no events";
  if (truth && !note) return values?.truth ? "no map yet" : "no ground truth here";
  return note && (edges || truth) ? "needs the events" : "no map yet";
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
    for (const kind of KINDS) this.#cell(kind);
    this.choose(FIRST_CHOICE);
    new ResizeObserver(() => {
      this.#rows();
      this.#fit();
    }).observe(byId("images").parentElement);
  }

  /** Shows these kinds (at least one), each at its place; they are drawn with the next answer. */
  choose(kinds) {
    const known = KINDS.map(({ kind }) => kind).filter((kind) => kinds.includes(kind));
    this.kinds = known.length ? known : FIRST_CHOICE;
    if (this.large !== null && !this.kinds.includes(this.large)) this.large = null;
    const place = byId("images");
    place.replaceChildren(...this.kinds.map((kind) => this.#cells.get(kind).figure));
    place.dataset.large = this.large ?? "";
    this.kinds.forEach((kind, i) => {
      const { figure } = this.#cells.get(kind);
      figure.title = `${figure.dataset.about} (${i + 1}: enlarge)`;
      figure.hidden = this.large !== null && this.large !== kind;
    });
    this.#rows();
    this.#fit();
  }

  /** The kinds that are on the screen now. */
  get asked() {
    return this.large ? [this.large] : this.kinds;
  }

  /** As many columns as make the pictures largest in what bars, captions and numbers leave. */
  #rows() {
    const place = byId("images");
    const count = this.asked.length;
    const font = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const style = getComputedStyle(place);
    const aspect = this.aspect ?? 4 / 3;
    const tall = place.parentElement.clientHeight - (4.4 + parseFloat(style.getPropertyValue("--panel-least"))) * font;
    const size = (columns) => {
      const wide = (place.clientWidth - 1.2 * font) / columns - 0.5 * font;
      return Math.min(wide, Math.max(5.5 * font, tall / Math.ceil(count / columns) - 1.7 * font) * aspect);
    };
    // One column only where that is worth its black sides.
    let columns = count > 1 && size(1) < 1.3 * size(2) ? 2 : 1;
    for (let more = columns + 1; more <= Math.min(count, 4); more++) if (size(more) > size(columns) + 1 || (size(more) >= size(columns) - 1 && Math.ceil(count / more) < Math.ceil(count / columns))) columns = more;
    place.style.setProperty("--columns", String(columns));
    place.style.setProperty("--rows", String(Math.ceil(count / columns)));
  }

  #cell({ kind, name, title, edges }) {
    const canvas = make("canvas", { width: 4, height: 3, role: "img", "aria-label": `${name}: ${title}` });
    const note = make("span", { class: "dim number" });
    const missing = make("span", { class: "missing dim" });
    const legend = edges ? make("span", { class: "edge-legend" }, make("i", { class: "explained", title: "explained by the map" }), kind === "map" ? make("span", {}, "explained") : null, make("i", { class: "unexplained", title: "not explained by the map" }), kind === "map" ? make("span", {}, "not") : null) : null;
    const figure = make(
      "button",
      { class: "cell", dataset: { kind, about: title }, "aria-pressed": "false", on: { click: () => this.enlarge(kind) } },
      make("span", { class: "caption" }, make("b", {}, name), legend, make("span", { class: "spring" }), note),
      make("span", { class: "picture" }, canvas, missing),
    );
    this.#cells.set(kind, { figure, canvas, note, missing, pen: canvas.getContext("2d") });
  }

  /** One image over the whole place, or all again. */
  enlarge(kind) {
    if (!this.kinds.includes(kind)) return;
    this.large = this.large === kind ? null : kind;
    byId("images").dataset.large = this.large ?? "";
    for (const [name, { figure }] of this.#cells) {
      figure.hidden = this.large !== null && this.large !== name;
      figure.setAttribute("aria-pressed", String(this.large === name));
    }
    this.#rows();
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
    for (const described of KINDS) {
      const { kind, name, note } = described;
      if (!this.asked.includes(kind)) continue;
      const cell = this.#cells.get(kind);
      const i = images.findIndex((image) => image.kind === kind);
      // A registration of frames has other pictures in the same places.
      const caption = values?.captions?.[kind];
      setText(cell.figure.querySelector(".caption b"), caption?.name ?? name);
      setText(cell.note, caption ? caption.note : values ? note(values) : "");
      const legend = cell.figure.querySelector(".edge-legend");
      if (legend) legend.hidden = Boolean(caption);
      if (i < 0) {
        this.#blank(cell, caption || values?.captions ? "none of this frame" : why(described, values));
        continue;
      }
      const { width, height } = bitmaps[i];
      if (cell.canvas.width !== width || cell.canvas.height !== height) {
        [cell.canvas.width, cell.canvas.height] = [width, height];
        if (kind !== "texture") {
          this.aspect = width / height;
          byId("images").style.setProperty("--aspect", `${width} / ${height}`);
          this.#rows();
        }
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
