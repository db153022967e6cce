// The landscape: a slice of the objective around the estimate, as a heat map in the place of the 3-D scene. It is asked
// for when the playhead rests; the server answers coarse first, then fine, and drops what was overtaken.

import { byId, make, setText, themeColour } from "./dom.js";
import { fixed, significant, whole } from "./format.js";
import { FONT, ticks } from "./lanes.js";

const REST_MS = 140;
const PATIENCE_MS = 1500;
const ZOOM = 1.6;
const RIDGE = 0.9; // share of the slice's height that its edge keeps where the summit is a ridge
const NAMES = ["rotation about x", "rotation about y", "rotation about z", "motion along x", "motion along y", "motion along z"];
const OBJECTIVES = [
  { value: "variance", text: "contrast: variance", of: "contrast", about: "How sharp the window's events become, by the velocity they are moved back along" },
  { value: "gradient", text: "contrast: gradient", of: "contrast", about: "The mean squared gradient of the same image" },
  { value: "map", text: "map score", of: "map score", about: "How well the window lies on the map of that moment, by the pose: 1 perfect, 0 chance" },
];
// Dark to light with even steps for all kinds of sight: blue, grey, yellow.
const RAMP = ["#00224e", "#123570", "#3b496c", "#575d6d", "#707173", "#8a8678", "#a59c74", "#c3b369", "#e1cc55", "#fee838"].map((hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16)));
const MARKS = [
  { key: "estimate", name: "estimate", about: "what the tracker found" },
  { key: "prior", name: "prior", about: "the previous window's motion carried on: where the search began" },
  { key: "truth", name: "truth", about: "the ground truth, laid on the slice" },
  { key: "best", name: "summit", about: "the highest cell" },
];

export class Landscape {
  #request = 0;
  #timer = 0;
  #late = 0;
  #zoom = 1;
  #answer = null;
  #chosen = false; // the axes are the person's choice, not the window's weakest direction

  /** `send(message)` says whether the line is open. */
  constructor(state, send) {
    Object.assign(this, { state, send });
    const option = (value, text) => make("option", { value }, text);
    this.objective = make("select", { "aria-label": "Landscape of", on: { change: () => this.#ask(0) } }, ...OBJECTIVES.map(({ value, text }) => option(value, text)));
    this.axes = ["across", "up"].map((name) => make("select", { "aria-label": `Parameter ${name}`, on: { change: (event) => this.#axis(event.target) } }, ...NAMES.map((text, i) => option(i, text))));
    [this.axes[0].value, this.axes[1].value] = [1, 3];
    this.canvas = make("canvas", { role: "img", "aria-label": "Landscape", tabindex: 0 });
    this.hint = make("p", { class: "landscape-hint dim", role: "status" });
    this.sentence = make("p", { class: "landscape-says" });
    this.legend = make("ul", { class: "landscape-marks number" });
    this.note = make("p", { class: "dim number landscape-note" });
    const zoom = (factor, text, title) => make("button", { title, "aria-label": title, on: { click: () => this.#zoomBy(factor) } }, text);
    this.panel = byId("landscape");
    this.panel.replaceChildren(
      make("div", { class: "landscape-bar" }, this.objective, this.axes[0], make("span", { class: "dim" }, "by"), this.axes[1], zoom(1 / ZOOM, "+", "Closer"), zoom(ZOOM, "−", "Wider"), make("span", { class: "spring" }), make("button", { class: "plain", title: "Back to the 3-D scene (G)", "aria-label": "Back to the 3-D scene", on: { click: () => this.toggle() } }, "×")),
      make("div", { class: "landscape-body" }, make("div", { class: "landscape-map" }, this.canvas, this.hint), make("div", { class: "landscape-side" }, this.sentence, this.legend, this.note)),
    );
    this.canvas.addEventListener("wheel", (event) => (event.preventDefault(), this.#zoomBy(event.deltaY > 0 ? ZOOM : 1 / ZOOM)), { passive: false });
    this.canvas.addEventListener("pointermove", (event) => this.#read(event));
    this.canvas.addEventListener("pointerleave", () => this.#read(null));
    byId("landscape-button").addEventListener("click", () => this.toggle());
    new ResizeObserver(() => this.#paint()).observe(this.canvas.parentElement);
    state.watch(["window", "session", "playing", "connected", "windows"], () => this.#ask(REST_MS));
    state.watch(["values"], () => this.#weakest());
  }

  get isOpen() {
    return !this.panel.hidden;
  }

  toggle() {
    this.panel.hidden = this.isOpen;
    byId("landscape-button").setAttribute("aria-pressed", String(this.isOpen));
    if (this.isOpen) {
      this.#weakest();
      this.#ask(0);
    } else if (this.panel.contains(document.activeElement)) byId("landscape-button").focus();
  }

  /** Colours changed. */
  restyle() {
    this.#paint();
  }

  /** Takes a `landscape` message; those of overtaken requests are dropped. */
  take(message) {
    if (message.request !== this.#request || message.session !== this.state.session) return;
    clearTimeout(this.#late);
    this.#answer = message.error ? null : message;
    setText(this.hint, message.error ? `No landscape here: ${message.error}.` : "");
    this.hint.hidden = !message.error;
    this.#paint();
    this.#words();
  }

  /** Until somebody chooses axes they are the two parameters that the texture tells apart least. */
  #weakest() {
    const words = this.state.values?.weak;
    if (this.#chosen || !this.isOpen || !words || this.state.values === this.weakOf) return;
    this.weakOf = this.state.values;
    const found = String(words).split(" and ").map((name) => NAMES.indexOf(name)).filter((axis) => axis >= 0).sort();
    if (found.length !== 2 || (found[0] === Number(this.axes[0].value) && found[1] === Number(this.axes[1].value))) return;
    [this.axes[0].value, this.axes[1].value] = found;
    this.#ask(0);
  }

  #axis(changed) {
    this.#chosen = true;
    const other = this.axes.find((select) => select !== changed);
    if (other.value === changed.value) other.value = (Number(changed.value) + 3) % 6;
    this.#ask(0);
  }

  #zoomBy(factor) {
    this.#zoom = Math.max(0.05, Math.min(20, this.#zoom * factor));
    this.#ask(60);
  }

  #ask(wait) {
    if (!this.isOpen) return;
    clearTimeout(this.#timer);
    const { state } = this;
    if (!state.session || !state.windows || state.playing) return;
    if (this.#answer && (this.#answer.window !== state.window || this.#answer.session !== state.session)) this.panel.classList.add("old");
    this.#timer = setTimeout(() => {
      const axes = this.axes.map(({ value }) => Number(value));
      const message = { type: "landscape", session: state.session, window: state.window, request: ++this.#request, objective: this.objective.value, axes, zoom: this.#zoom };
      if (!this.send(message)) return;
      clearTimeout(this.#late);
      // The first one on a machine waits for its kernels to be compiled.
      this.#late = setTimeout(() => {
        this.hint.hidden = false;
        setText(this.hint, "Computing; the first landscape on a machine takes some seconds longer.");
      }, PATIENCE_MS);
    }, wait);
  }

  #words() {
    const a = this.#answer;
    this.panel.classList.toggle("old", !a);
    this.legend.replaceChildren();
    setText(this.note, "");
    if (!a) return setText(this.sentence, "");
    const kind = OBJECTIVES.find(({ value }) => value === a.objective);
    const cell = a.axes.map(({ from, to }) => (to - from) / (a.cells - 1));
    const apart = (p, q) => Math.hypot((p[0] - q[0]) / cell[0], (p[1] - q[1]) / cell[1]);
    setText(this.sentence, this.#judge(a, kind, apart));
    const digits = cell.map((step) => Math.max(0, Math.min(4, Math.ceil(-Math.log10(step)))));
    const where = (place) => place.map((value, i) => `${fixed(value, digits[i])} ${a.axes[i].unit}`).join(", ");
    this.legend.append(
      ...MARKS.filter(({ key }) => a[key]).map(({ key, name, about }) => make("li", { title: about }, make("i", { class: `mark-${key}` }), make("b", {}, name), make("span", {}, where(a[key])))),
    );
    const events = a.events < a.of_events ? `${whole(a.events)} of ${whole(a.of_events)} events` : `${whole(a.events)} events`;
    setText(this.note, `${kind.about}. ${a.cells} × ${a.cells} cells, ${events}, ${whole(a.milliseconds)} ms.`);
  }

  #judge(a, kind, apart) {
    if (a.at_estimate === null || !a.best) return "The window lies off the map here.";
    if (this.#onRidge(a)) return `The estimate stands on a ridge: ${a.axes[0].name} and ${a.axes[1].name} can hardly be told apart in this window.`;
    if (apart(a.best, a.estimate) < 1.6) return a.truth && apart(a.truth, a.estimate) > 3 && this.#inside(a, a.truth) ? "The estimate stands on the summit of this slice, and the truth does not: this objective prefers a wrong answer here." : "The estimate stands on the summit of this slice.";
    const gain = kind.value === "map" ? a.at_best - a.at_estimate : a.at_best / a.at_estimate - 1;
    if (gain < 0.02) return "Another place of this slice is as good as the estimate: the window does not tell them apart.";
    const more = kind.value === "map" ? `map score ${fixed(a.at_best)} instead of ${fixed(a.at_estimate)}` : `${fixed(100 * gain, 0)} % more contrast`;
    const nearTruth = a.truth && apart(a.best, a.truth) < Math.min(4, apart(a.estimate, a.truth));
    return `There is a higher summit in this slice (${more})${nearTruth ? ", and the truth lies there: the search ended in a local optimum." : ": the search ended beside it."}`;
  }

  /** Whether the slice's edge keeps nearly the height of its summit, and the estimate does too. */
  #onRidge({ values, cells, at_estimate: at }) {
    const known = values.flat().filter(Number.isFinite);
    const [low, high] = [Math.min(...known), Math.max(...known)];
    if (at < low + RIDGE * (high - low)) return false;
    const edge = values.flatMap((row, r) => row.filter((_, c) => [0, cells - 1].includes(r) || [0, cells - 1].includes(c)));
    return Math.max(...edge.filter(Number.isFinite)) > low + RIDGE * (high - low);
  }

  #inside = (a, place) => place.every((value, i) => value >= a.axes[i].from && value <= a.axes[i].to);

  /** Where the map lies on the canvas, in CSS pixels. */
  #layout() {
    const box = this.canvas.parentElement.getBoundingClientRect();
    const font = parseFloat(getComputedStyle(document.documentElement).fontSize) * 0.88;
    const [left, right, top, bottom] = [font * 5.2, font * 7, font * 0.9, font * 4.2];
    const size = Math.max(60, Math.min(box.width - left - right, box.height - top - bottom));
    const middle = (free) => Math.max(0, free / 2);
    return { width: box.width, height: box.height, font, left: left + middle(box.width - left - right - size), top: top + middle(box.height - top - bottom - size), size };
  }

  #paint() {
    const a = this.#answer;
    const pen = this.canvas.getContext("2d");
    const { width, height, font, left, top, size } = this.#layout();
    if (!this.isOpen || width < 10) return;
    const ratio = devicePixelRatio || 1;
    [this.canvas.width, this.canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    if (!a) return;
    const known = a.values.flat().filter(Number.isFinite);
    const [low, high] = [Math.min(...known), Math.max(...known)];
    const tile = new OffscreenCanvas(a.cells, a.cells);
    const data = new ImageData(a.cells, a.cells);
    a.values.forEach((row, r) =>
      row.forEach((value, c) => {
        const at = 4 * ((a.cells - 1 - r) * a.cells + c); // the second parameter grows upwards
        if (value === null) return;
        colour((value - low) / (high - low || 1)).forEach((level, i) => (data.data[at + i] = level));
        data.data[at + 3] = 255;
      }),
    );
    tile.getContext("2d").putImageData(data, 0, 0);
    pen.fillStyle = themeColour("--raise");
    pen.fillRect(left, top, size, size);
    pen.imageSmoothingEnabled = false;
    pen.drawImage(tile, left, top, size, size);
    const [ink, dim] = ["--fg", "--dim"].map(themeColour);
    const half = size / a.cells / 2;
    const x = (value) => left + half + ((value - a.axes[0].from) / (a.axes[0].to - a.axes[0].from)) * (size - 2 * half);
    const y = (value) => top + size - half - ((value - a.axes[1].from) / (a.axes[1].to - a.axes[1].from)) * (size - 2 * half);
    pen.font = `${font}px ${FONT}`;
    pen.fillStyle = dim;
    pen.textBaseline = "top";
    pen.textAlign = "center";
    const label = (value, step) => fixed(value, Math.max(0, Math.min(4, Math.ceil(-Math.log10(step) - 1e-9))));
    const across = ticks(a.axes[0].from, a.axes[0].to, size / 70);
    for (const value of across.values) {
      pen.fillRect(x(value) - 0.5, top + size, 1, 4);
      pen.fillText(label(value, across.step), x(value), top + size + 6);
    }
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    const up = ticks(a.axes[1].from, a.axes[1].to, size / 50);
    for (const value of up.values) {
      pen.fillRect(left - 4, y(value) - 0.5, 4, 1);
      pen.fillText(label(value, up.step), left - 7, y(value));
    }
    pen.fillStyle = ink;
    pen.textAlign = "center";
    pen.textBaseline = "top";
    pen.fillText(`${a.axes[0].name} (${a.axes[0].unit})`, left + size / 2, top + size + 6 + 1.35 * font);
    pen.save();
    pen.translate(left - 4.6 * font, top + size / 2);
    pen.rotate(-Math.PI / 2);
    pen.fillText(`${a.axes[1].name} (${a.axes[1].unit})`, 0, 0);
    pen.restore();
    this.#bar(pen, a, { left: left + size + font, top, size, font, low, high, ink, dim });
    for (const { key } of [...MARKS].reverse()) {
      if (!a[key]) continue;
      const at = [Math.max(left, Math.min(left + size, x(a[key][0]))), Math.max(top, Math.min(top + size, y(a[key][1])))];
      drawMark(pen, key, ...at, font * 0.62, !this.#inside(a, a[key]));
    }
    this.canvas.setAttribute("aria-label", `Landscape of window ${a.window}: ${a.axes[1].name} by ${a.axes[0].name}`);
    this.canvas.dataset.window = a.window;
    this.canvas.dataset.cells = a.cells;
  }

  #bar(pen, a, { left, top, size, font, low, high, ink, dim }) {
    for (let i = 0; i < size; i++) {
      pen.fillStyle = `rgb(${colour(1 - i / size).join(" ")})`;
      pen.fillRect(left, top + i, font * 0.8, 1.5);
    }
    const relative = a.objective !== "map" && a.at_estimate > 0;
    const unit = relative ? a.at_estimate : 1;
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    pen.fillStyle = dim;
    const { values, step } = ticks(low / unit, high / unit, size / 45);
    for (const value of values) {
      const y = top + size * (1 - (value * unit - low) / (high - low || 1));
      pen.fillRect(left + font * 0.8, y - 0.5, 4, 1);
      pen.fillText(fixed(value, Math.max(0, Math.ceil(-Math.log10(step) - 1e-9))), left + font * 0.8 + 7, y);
    }
    pen.fillStyle = ink;
    pen.textBaseline = "top";
    pen.fillText(relative ? "contrast," : "map score", left, top + size + 6 + 1.35 * font);
    if (relative) pen.fillText("estimate = 1", left, top + size + 6 + 2.5 * font);
  }

  /** Says what stands under the pointer. */
  #read(event) {
    const a = this.#answer;
    if (!a) return;
    if (!event) return this.canvas.removeAttribute("title");
    const { left, top, size } = this.#layout();
    const c = Math.floor(((event.offsetX - left) / size) * a.cells);
    const r = a.cells - 1 - Math.floor(((event.offsetY - top) / size) * a.cells);
    const value = a.values[r]?.[c];
    if (value === undefined) return this.canvas.removeAttribute("title");
    const place = [c, r].map((k, i) => `${significant(a.axes[i].from + (k / (a.cells - 1)) * (a.axes[i].to - a.axes[i].from))} ${a.axes[i].unit}`);
    this.canvas.title = `${place.join(", ")}: ${value === null ? "off the map" : significant(value)}`;
  }
}

function colour(share) {
  const at = Math.max(0, Math.min(0.9999, share)) * (RAMP.length - 1);
  const k = Math.floor(at);
  return RAMP[k].map((level, i) => Math.round(level + (at - k) * (RAMP[k + 1][i] - level)));
}

/** A mark with a dark edge, so that it is seen on every colour; hollow and small where it lies outside the slice. */
function drawMark(pen, key, x, y, r, outside) {
  const shape = () => {
    pen.beginPath();
    if (key === "estimate") {
      pen.moveTo(x - 1.6 * r, y), pen.lineTo(x + 1.6 * r, y);
      pen.moveTo(x, y - 1.6 * r), pen.lineTo(x, y + 1.6 * r);
    } else if (key === "prior") pen.rect(x - r * 0.8, y - r * 0.8, 1.6 * r, 1.6 * r);
    else if (key === "truth") {
      pen.moveTo(x, y - 1.3 * r), pen.lineTo(x + 1.3 * r, y), pen.lineTo(x, y + 1.3 * r), pen.lineTo(x - 1.3 * r, y), pen.closePath();
    } else pen.arc(x, y, 0.9 * r, 0, 2 * Math.PI);
  };
  pen.save();
  if (outside) pen.globalAlpha = 0.55;
  for (const [style, wide] of [["#000", 4.5], [key === "truth" ? "#ff8fd0" : "#fff", 2.2]]) {
    pen.strokeStyle = style;
    pen.lineWidth = wide;
    shape();
    pen.stroke();
  }
  pen.restore();
}
