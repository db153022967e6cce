// Trying again from the playhead's window: other settings, or a camera that is dragged to where it was; the
// branches that were tried, live beside the session.

import * as api from "./api.js";
import { address } from "./address.js";
import { byId, make, setText } from "./dom.js";
import { clockTime, fixed, percent } from "./format.js";
import { ask } from "./live.js";
import { angleBetween } from "./numbers.js";
import { nudged } from "./poses.js";
import { Settings } from "./settings.js";

const PREVIEW_MS = 120;
const STOP_MS = 200; // a run that is stopped needs a moment to end
const STOP_TRIES = 60;
const MOVE = 0.01; // plane distances
const TURN = 1; // degrees
const AXES = ["x", "y", "z"];

/** What a branch changed, in words. */
export function tried(origin) {
  const word = (value) => (value === null ? "automatic" : String(value));
  const words = Object.entries(origin.changes).map(([name, [before, after]]) => `${name.replaceAll("_", " ")} ${word(after)} instead of ${word(before)}`);
  if (origin.placed) words.push("pose by hand");
  return words.join(", ") || "nothing changed";
}

/** The branches of a session among the entries of the list, and of one without a file yet. */
export const branchesOf = (entry, entries) =>
  entries.filter(({ origin }) => origin && origin.session === entry?.name && (!origin.created || !entry.created || origin.created === entry.created));

export class Branching {
  #pose = null; // {position, quaternion_wxyz} while a camera is placed
  #held = null; // the window it was placed at
  #from = null; // the pose it was placed at first
  #previewing = false;
  #again = false;
  #session = null;
  #wanted = null; // a branch that is shown as soon as it has begun

  /** `parts` are {state, socket, beside}; `problem(sentence)` says what went wrong; `manage(name)` opens its dialog. */
  constructor({ state, socket, beside }, { problem, manage }) {
    Object.assign(this, { state, socket, beside, problem, manage });
    this.#build();
    socket.addEventListener("gizmo", ({ detail }) => this.#pose && this.#moved({ position: detail.position, quaternion_wxyz: detail.quaternion_wxyz }, false));
    socket.addEventListener("open", () => this.#pose && socket.send({ type: "gizmo", pose: this.#pose }));
    state.watch(["session", "detail"], () => this.#opened());
    state.watch(["window", "values", "live", "columns"], () => this.#enable());
    state.watch(["sessions"], () => this.#listed());
    byId("try-here").addEventListener("click", () => this.begin());
  }

  /** The key and the button: the panel is shown. */
  begin() {
    byId("tab-try").click();
    this.go.focus();
  }

  #build() {
    this.title = make("h3");
    this.form = make("div", { class: "try-settings" });
    this.placing = make("input", { type: "checkbox", id: "try-place", on: { change: () => (this.placing.checked ? this.#place() : this.#unplace()) } });
    this.apart = make("p", { class: "dim number" });
    this.picture = make("img", { alt: "The window's events on the map from the placed camera" });
    this.explained = make("p", { class: "number", role: "status" });
    const step = (name, change) => make("button", { type: "button", title: name, "aria-label": name, on: { click: () => this.#moved(change(this.#pose), true) } }, name.startsWith("+") ? "+" : "−");
    const row = (what, unit, change) =>
      make("div", { class: "nudge" }, make("span", {}, what), ...AXES.map((axis, i) => make("span", { class: "axis" }, step(`−${what} ${axis}`, (pose) => change(pose, i, -1)), axis, step(`+${what} ${axis}`, (pose) => change(pose, i, 1)))), make("span", { class: "dim" }, unit));
    const unit = (axis, size) => [0, 1, 2].map((i) => (i === axis ? size : 0));
    this.truth = make("button", { type: "button", title: "Put the camera where the ground truth has it", on: { click: () => this.#moved(this.state.values.truth, true) } }, "true pose");
    this.placed = make(
      "div",
      { class: "placed", hidden: true },
      make("p", { class: "dim" }, "Drag the arrows and rings in the scene until the edges lie on the map, or step:"),
      row("move", `${MOVE} d`, (pose, axis, sign) => nudged(pose, unit(axis, sign * MOVE))),
      row("turn", `${TURN}°`, (pose, axis, sign) => nudged(pose, [0, 0, 0], axis, sign * TURN)),
      make("div", { class: "nudge-ends" }, make("button", { type: "button", on: { click: () => this.#moved(this.#from, true) } }, "back to the estimate"), this.truth),
      this.apart,
    );
    this.seen = make("figure", { class: "trial-seen", hidden: true }, this.picture, make("figcaption", {}, this.explained));
    byId("scene").append(this.seen);
    this.go = make("button", { type: "button", class: "accent go", on: { click: () => this.#start() } });
    this.why = make("p", { class: "dim" });
    this.origin = make("div", { class: "origin" });
    this.list = make("ul", { class: "branches" });
    byId("panel-try").replaceChildren(this.origin, this.list, this.title, this.form, make("label", { class: "check" }, this.placing, "Start from a pose of my own"), this.placed, this.go, this.why);
  }

  /** Another session is open, or more is known about it. */
  #opened() {
    const { detail, session } = this.state;
    const entry = this.state.sessions?.find(({ name }) => name === session);
    if (session !== this.#session) {
      this.#session = session;
      this.#wanted = null;
      this.#unplace();
      this.beside.show(null);
      this.settings = null;
      this.form.replaceChildren();
    }
    if (detail && !this.settings) this.#fill(detail.config);
    this.origin.replaceChildren(...(detail?.origin ? this.#originOf(detail.origin, entry) : []));
    this.#enable();
    this.#listed();
  }

  async #fill(config) {
    const { session } = this.state;
    this.settings = "asked";
    try {
      const { config: fields } = await api.recordings();
      if (session !== this.state.session) return;
      this.settings = new Settings(fields.filter(({ name }) => name !== "plane_distance"));
      this.settings.set(config ?? {});
      this.form.replaceChildren(...this.settings.rows);
    } catch (error) {
      this.settings = null;
      this.problem(error.message);
    }
    this.#enable();
  }

  #originOf(origin, entry) {
    const { session } = this.state;
    return [
      make("p", {}, "Branch of ", make("a", { href: address(origin.session, origin.window) }, origin.session), ` from window ${origin.window}: ${tried(origin)}.`),
      entry && !entry.kept ? make("div", { class: "actions" }, make("button", { type: "button", on: { click: () => this.manage(session) } }, "Keep…"), make("button", { type: "button", on: { click: () => this.#discard(session) } }, "Discard")) : "",
    ];
  }

  #enable() {
    const { state } = this;
    const window = this.#held ?? state.window;
    const can = Boolean(state.detail?.recording_found) && state.windows > 0 && this.settings instanceof Settings;
    this.go.disabled = !can;
    byId("try-here").disabled = !state.windows;
    setText(this.title, state.windows ? `From window ${window}, ${clockTime(state.timeOf(window))}` : "");
    setText(this.go, state.windows ? `Try again from window ${window}` : "Try again");
    const map = state.detail?.map_revisions.some((revision) => revision.window < window) ?? false;
    this.placing.disabled = !can || (!map && !this.#pose);
    const why = !state.windows ? "" : !state.detail?.recording_found ? "The recording is not there any more: nothing can be tracked anew." : !map ? "There is no map yet at this window: a pose can be given later in the session." : "";
    setText(this.why, why);
    this.why.hidden = !why;
    this.truth.hidden = !state.values?.truth || state.shown !== window;
  }

  // The camera that is placed --------------------------------------------------------------------------------

  #place() {
    const { values, window } = this.state;
    if (!values?.position?.every(Number.isFinite)) {
      this.placing.checked = false;
      return this.problem("This window has no pose to start from.");
    }
    this.#held = window;
    this.#from = { position: values.position, quaternion_wxyz: values.quaternion_wxyz };
    this.placed.hidden = this.seen.hidden = false;
    this.#moved(this.#from, true);
    this.#enable();
  }

  #unplace() {
    this.placing.checked = false;
    this.placed.hidden = this.seen.hidden = true;
    this.picture.removeAttribute("src");
    if (this.#pose) this.socket.send({ type: "gizmo", pose: null });
    this.#pose = this.#held = this.#from = null;
    this.#enable();
  }

  /** The camera is somewhere else; `tell` moves it in the scene too. */
  #moved({ position, quaternion_wxyz }, tell) {
    this.#pose = { position, quaternion_wxyz };
    if (tell) this.socket.send({ type: "gizmo", pose: this.#pose });
    const far = Math.hypot(...position.map((value, i) => value - this.#from.position[i]));
    setText(this.apart, `${fixed(far, 3)} d and ${fixed(angleBetween(quaternion_wxyz, this.#from.quaternion_wxyz), 1)}° from the estimate`);
    this.#preview();
  }

  async #preview() {
    if (this.#previewing) return void (this.#again = true);
    this.#previewing = true;
    this.#again = false;
    try {
      const { png, explained } = await api.preview(this.state.session, { window: this.#held, pose: this.#pose });
      if (this.#pose) {
        this.picture.src = `data:image/png;base64,${png}`;
        setText(this.explained, Number.isFinite(explained) ? `${percent(explained)} of the edges lie on the map` : "no edges in this window");
      }
    } catch (error) {
      if (this.#pose) setText(this.explained, error.message);
    }
    await new Promise((resolve) => setTimeout(resolve, PREVIEW_MS));
    this.#previewing = false;
    if (this.#again && this.#pose) this.#preview();
  }

  // Branches -------------------------------------------------------------------------------------------------

  async #start() {
    const { session } = this.state;
    this.go.disabled = true;
    try {
      const body = { window: this.#held ?? this.state.window, config: this.settings.get(), pose: this.#pose };
      const { name } = await api.branch(session, body);
      if (session !== this.state.session) return;
      this.#wanted = name;
      this.#unplace();
      this.#listed();
    } catch (error) {
      this.problem(error.message);
    } finally {
      this.#enable();
    }
  }

  async #discard(name) {
    if (!(await ask(`Discard “${name}”?`, "The branch is deleted. The session it was tried from and the recording stay.", "Discard", "Keep it"))) return;
    const entry = () => this.state.sessions?.find((session) => session.name === name);
    try {
      if (this.beside.name === name) this.beside.show(null);
      // A run that ends at this very moment cannot be stopped any more, which is as well.
      if (entry()?.run) await api.run(name, "cancel").catch(() => {});
      for (let tries = 0; entry()?.run && tries < STOP_TRIES; tries++) await new Promise((resolve) => setTimeout(resolve, STOP_MS));
      if (entry()) await api.change(name, { do: "delete", name });
    } catch (error) {
      this.problem(error.message);
    }
  }

  #listed() {
    const { sessions, session } = this.state;
    const entry = sessions?.find(({ name }) => name === session);
    const branches = entry ? branchesOf(entry, sessions) : [];
    setText(byId("tab-try"), branches.length ? `Try again ${branches.length}` : "Try again");
    const begun = branches.find(({ name, windows }) => name === this.#wanted && windows > 0);
    if (begun) {
      this.#wanted = null;
      this.beside.show(begun.name, begun.origin.window);
    }
    const shown = branches.find(({ name }) => name === this.beside.name);
    if (!shown && this.beside.name && sessions) this.beside.show(null);
    if (shown && shown.state !== "live" && this.lastState === "live") this.beside.ended();
    this.lastState = shown?.state ?? null;
    this.show(branches);
  }

  /** Draws the list of branches. */
  show(branches = branchesOf(this.state.sessions?.find(({ name }) => name === this.state.session), this.state.sessions ?? [])) {
    const focused = document.activeElement?.closest?.(".branches") ? [document.activeElement.dataset.do, document.activeElement.dataset.name] : null;
    this.list.replaceChildren(...branches.map((branch) => this.#row(branch)));
    if (focused) this.list.querySelector(`[data-do="${focused[0]}"][data-name="${CSS.escape(focused[1])}"]`)?.focus();
  }

  #row(branch) {
    const { name, origin, run, state, windows, error } = branch;
    const isShown = this.beside.name === name;
    const button = (what, words, click, extra = {}) => make("button", { type: "button", dataset: { do: what, name }, on: { click }, ...extra }, words);
    const where = { queued: "waits for its turn", starting: "getting to window " + origin.window, failed: error || "failed", live: run?.state === "paused" ? "paused" : "live", incomplete: "ended early" }[state] ?? (run ? "ending" : "done");
    const actions = [];
    if (windows) actions.push(button("beside", isShown ? "hide" : "show", () => this.beside.show(isShown ? null : name, origin.window), { "aria-pressed": String(isShown), title: "Draw it beside this session" }));
    if (windows) actions.push(make("a", { class: "button", href: address(name, null) }, "open"));
    if (windows && !run) actions.push(make("a", { class: "button", href: `?compare=${encodeURIComponent(name)}${address(this.state.session, null)}` }, "compare"));
    if (run) actions.push(button("stop", "stop", () => api.run(name, "cancel").catch((why) => this.problem(why.message))));
    if (!branch.kept && windows && !run) actions.push(button("keep", "keep…", () => this.manage(name)));
    if (!branch.kept || state === "failed") actions.push(button("discard", "discard", () => this.#discard(name)));
    const isKnown = Number.isFinite(run?.share) && run.stage === "tracking";
    const share = isKnown ? make("progress", { max: 1, value: run.share, "aria-label": `Progress of ${name}` }) : null;
    return make(
      "li",
      { dataset: { branch: name }, class: isShown ? "shown" : null },
      make("p", {}, make("b", {}, name), make("span", { class: "dim" }, ` ${where}${share ? ` ${percent(run.share)}` : ""}`)),
      make("p", { class: "dim" }, `from window ${origin.window}: ${tried(origin)}`),
      share,
      isShown ? this.#figures(origin) : null,
      make("div", { class: "actions" }, ...actions),
    );
  }

  #figures(origin) {
    const difference = this.beside.difference(origin.window);
    if (!difference) return null;
    const { before, after } = difference;
    const rows = [["tracked", percent(before.tracked), percent(after.tracked)]];
    if (Number.isFinite(after.percent)) rows.push(["position error", `${fixed(before.percent, 2)} % d`, `${fixed(after.percent, 2)} % d`]);
    if (Number.isFinite(after.deg)) rows.push(["rotation error", `${fixed(before.deg, 2)}°`, `${fixed(after.deg, 2)}°`]);
    return make(
      "table",
      { class: "difference number" },
      make("thead", {}, make("tr", {}, make("th", {}, make("span", { class: "visually-hidden" }, "figure")), make("th", { scope: "col" }, "this session"), make("th", { scope: "col", class: "tried" }, "branch"))),
      make("tbody", {}, ...rows.map(([label, a, b]) => make("tr", {}, make("th", { scope: "row" }, label), make("td", {}, a), make("td", {}, b)))),
      make("caption", { class: "dim" }, `From window ${origin.window} on; errors are medians.`),
    );
  }
}
