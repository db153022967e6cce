// Starting a run: a recording of the server's list, settings, calibration, what it will take.

import * as api from "./api.js";
import { byId, make, setText } from "./dom.js";
import { amount, duration, fixed, megaRate } from "./format.js";
import { Settings, field, numberField, numberIn } from "./settings.js";

const READ_AGAIN_MS = 400;
const INTRINSICS = ["fx", "fy", "cx", "cy"];
const DISTORTION = ["k1", "k2", "p1", "p2", "k3"];
const CROWDED = 1.2; // the estimate is no better than that

/** Bytes in words. */
export function bytes(count) {
  if (!Number.isFinite(count)) return "–";
  for (const [unit, size] of [["GB", 1e9], ["MB", 1e6], ["kB", 1e3]]) if (count >= size) return `${fixed(count / size, count >= 100 * size ? 0 : 1)} ${unit}`;
  return `${Math.round(count)} B`;
}

export class RunDialog {
  #asked = 0; // counts chosen recordings: answers for an older one are dropped
  #chosen = null; // id of the chosen recording
  #detail = null; // what is known of it

  /** `started(name)` is called with the new session's name. */
  constructor({ started }) {
    this.started = started;
    this.dialog = byId("track");
    byId("track-button").addEventListener("click", () => this.open());
    this.dialog.addEventListener("close", () => this.#asked++);
  }

  /** Opens the dialog; the list of recordings is asked for anew. */
  async open() {
    if (this.dialog.open) return;
    this.#chosen = this.#detail = null;
    this.#build();
    this.dialog.showModal();
    this.filter.focus();
    try {
      const { recordings, config } = await api.recordings();
      this.recordings = recordings;
      this.fields = config;
      this.#list();
    } catch (error) {
      this.list.replaceChildren(make("li", { class: "hint bad" }, error.message));
    }
  }

  #build() {
    this.recordings = [];
    this.filter = make("input", { type: "search", placeholder: "Filter recordings", "aria-label": "Filter recordings", autocomplete: "off", spellcheck: "false", on: { input: () => this.#list() } });
    this.list = make("ul", { class: "recordings", "aria-label": "Recordings" }, make("li", { class: "hint dim" }, "Looking for recordings"));
    this.side = make("div", { class: "run-detail" }, make("p", { class: "dim hint" }, "Choose a recording."));
    this.problem = make("p", { class: "bad", role: "alert", hidden: true });
    this.go = make("button", { type: "button", class: "accent", disabled: true, on: { click: () => this.#start() } }, "Start tracking");
    this.dialog.replaceChildren(
      make("header", {}, make("h2", { id: "track-title" }, "Track a recording"), make("button", { type: "button", on: { click: () => this.dialog.close() } }, "Close")),
      make("div", { class: "run-columns" }, make("div", { class: "run-list" }, this.filter, this.list), this.side),
      make("footer", {}, this.problem, make("span", { class: "spring" }), make("button", { type: "button", on: { click: () => this.dialog.close() } }, "Cancel"), this.go),
    );
    this.list.addEventListener("keydown", (event) => {
      const move = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (!move) return;
      event.preventDefault();
      const rows = [...this.list.querySelectorAll("button")];
      (rows[rows.indexOf(document.activeElement) + move] ?? this.filter).focus();
    });
    this.filter.addEventListener("keydown", (event) => event.key === "ArrowDown" && (event.preventDefault(), this.list.querySelector("button")?.focus()));
  }

  #list() {
    const wanted = this.filter.value.trim().toLowerCase();
    const found = this.recordings.filter(({ file, folder }) => `${folder}/${file}`.toLowerCase().includes(wanted));
    if (!found.length) {
      const text = this.recordings.length ? `No recording's name holds “${wanted}”.` : "No recordings yet. Put them into the sessions' folder, or name a folder when the server is started: dvsviz serve --recordings FOLDER.";
      return this.list.replaceChildren(make("li", { class: "hint dim" }, text));
    }
    this.list.replaceChildren(
      ...found.map(({ id, file, folder, bytes: size }) =>
        make("li", {}, make("button", { type: "button", class: "row", dataset: { recording: id }, "aria-pressed": String(id === this.#chosen), on: { click: () => this.#choose(id) } }, make("b", {}, file), make("span", { class: "dim number" }, `${folder} · ${bytes(size)}`))),
      ),
    );
  }

  async #choose(id) {
    const mine = ++this.#asked;
    this.#chosen = id;
    this.#detail = null;
    this.go.disabled = true;
    this.#say("");
    for (const row of this.list.querySelectorAll("[data-recording]")) row.setAttribute("aria-pressed", String(row.dataset.recording === id));
    const bar = make("progress", { "aria-label": "Reading" });
    this.side.replaceChildren(make("p", { class: "dim" }, "Reading the recording. Formats other than dvsviz's own are converted once."), bar);
    try {
      for (;;) {
        const answer = await api.recording(id);
        if (mine !== this.#asked) return;
        if (answer.state === "ready") return this.#show(answer);
        if (answer.share > 0) bar.value = answer.share;
        await new Promise((resolve) => setTimeout(resolve, READ_AGAIN_MS));
        if (mine !== this.#asked) return;
      }
    } catch (error) {
      if (mine === this.#asked) this.side.replaceChildren(make("h3", {}, "This recording cannot be read"), make("p", { class: "bad" }, error.message));
    }
  }

  #show(detail) {
    this.#detail = detail;
    const changed = () => this.#reckon();
    this.name = make("input", { type: "text", value: detail.name, maxlength: 120, autocomplete: "off", spellcheck: "false" });
    this.settings = new Settings(this.fields, changed);
    this.start = numberField({ placeholder: "0" });
    this.end = numberField({ placeholder: fixed(detail.duration_s, 3) });
    this.hot = make("input", { type: "checkbox" });
    this.background = numberField({ placeholder: "off" });
    this.refractory = numberField({ placeholder: "off" });
    this.camera = Object.fromEntries([...INTRINSICS, ...DISTORTION].map((name) => [name, numberField({ "aria-label": name, dataset: { camera: name } })]));
    this.lens = make("p", { class: "dim" });
    this.estimate = make("p", { class: "estimate", role: "status" });
    for (const input of [this.start, this.end, this.hot, this.background, this.refractory, ...Object.values(this.camera)]) input.addEventListener("input", changed);
    this.#setCamera();
    const guess = detail.camera.is_guess;
    this.side.replaceChildren(
      make("p", { class: "run-facts number" }, [detail.format, `${detail.width}×${detail.height}`, duration(detail.duration_s), `${amount(detail.events)} events`, detail.ground_truth ? "with ground truth" : "no ground truth"].join(" · ")),
      ...detail.warnings.map((text) => make("p", { class: "dim" }, text)),
      group("Session", field("Name", this.name), ...this.settings.rows),
      group("Part of the recording", field("Start", this.start, "s"), field("End", this.end, "s")),
      group("Filters", field("Hot pixels", this.hot, "drop"), field("Background", this.background, "µs", "Keep an event only where a neighbouring pixel fired within this time before it"), field("Refractory", this.refractory, "µs", "Drop an event that follows one of its pixel within this time")),
      group(
        "Calibration",
        guess
          ? make("p", { class: "guess" }, make("b", {}, "Guessed. "), "The recording says nothing about its lens. A wrong focal length is the commonest cause of drift: enter the calibrated values if you have them.")
          : make("p", { class: "dim" }, "As recorded. A wrong focal length is the commonest cause of drift."),
        make("div", { class: "camera-grid" }, ...INTRINSICS.map((name) => field(name, this.camera[name], "px"))),
        make("div", { class: "camera-grid" }, ...DISTORTION.map((name) => field(name, this.camera[name]))),
        this.lens,
        make("button", { type: "button", class: "plain", on: { click: () => (this.#setCamera(), changed()) } }, guess ? "Back to the guess" : "Back to the recorded values"),
      ),
      this.estimate,
    );
    this.side.scrollTop = 0;
    this.#reckon();
  }

  #setCamera() {
    const { camera } = this.#detail;
    for (const name of INTRINSICS) this.camera[name].value = Number(camera[name].toFixed(4));
    DISTORTION.forEach((name, i) => (this.camera[name].value = camera.distortion[i]));
  }

  /** What the run will take, from what is in the form now. */
  #reckon() {
    const { estimate: e, duration_s: whole, events, width } = this.#detail;
    const start = numberIn(this.start) ?? 0;
    const end = Math.min(numberIn(this.end) ?? whole, whole);
    const share = Math.max(0, end - start) / whole;
    const fx = numberIn(this.camera.fx);
    const across = (2 * Math.atan(width / (2 * fx)) * 180) / Math.PI;
    setText(this.lens, fx > 0 ? `This lens sees ${fixed(across, 0)}° across.` : "");
    const good = Number.isFinite(share) && share > 0;
    this.go.disabled = !good;
    if (!good) return this.#estimate("There is nothing between start and end.", true);
    const size = e.bytes_per_s * share * whole;
    const filtered = this.hot.checked || this.background.value.trim() || this.refractory.value.trim();
    const seconds = (events * share) / e.events_per_second;
    const source = e.measured_on ? "" : ", not measured on this machine yet";
    const words = [`About ${bytes(size)} on disk`, `${bytes(e.free_bytes)} free`, `about ${duration(seconds)} at ${megaRate(e.events_per_second)}${source}`];
    if (filtered) words.push(`${bytes(e.copy_bytes)} for the filtered copy`);
    const short = e.free_bytes !== null && size * CROWDED > e.free_bytes;
    const copyShort = filtered && e.free_copy_bytes !== null && e.copy_bytes * CROWDED > e.free_copy_bytes;
    this.#estimate(`${short || copyShort ? "The disk is too full. " : ""}${words.join(" · ")}`, short || copyShort);
  }

  #estimate(text, bad) {
    setText(this.estimate, text);
    this.estimate.classList.toggle("bad", bad);
  }

  #say(text) {
    this.problem.textContent = text;
    this.problem.hidden = !text;
  }

  #number(input, label) {
    const value = numberIn(input);
    if (value === null || Number.isFinite(value)) return value;
    input.focus();
    throw new Error(`${label}: a number is needed.`);
  }

  async #start() {
    this.#say("");
    this.go.disabled = true;
    try {
      const needed = (name) => this.#number(this.camera[name], name) ?? 0;
      const camera = { ...Object.fromEntries(INTRINSICS.map((name) => [name, needed(name)])), distortion: DISTORTION.map(needed) };
      const filters = { hot_pixels: this.hot.checked, background_us: this.#number(this.background, "Background"), refractory_us: this.#number(this.refractory, "Refractory") };
      const body = { recording: this.#chosen, name: this.name.value, config: this.settings.get(), start_s: this.#number(this.start, "Start"), end_s: this.#number(this.end, "End"), filters, camera };
      const { name } = await api.startRun(body);
      this.dialog.close();
      this.started(name);
    } catch (error) {
      this.#say(error.message);
    } finally {
      this.go.disabled = !this.#detail;
    }
  }
}

function group(title, ...rows) {
  return make("fieldset", {}, make("legend", {}, title), ...rows);
}
