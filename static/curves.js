// Which curves the timeline shows, and those of them that are fetched only when they are wanted.

import * as api from "./api.js";
import { byId, make, setText } from "./dom.js";
import { popover } from "./popover.js";

const KEY = "dvsviz-curves";
const AGAIN_MS = 60;

const axis = (key, unit, least) => ({ key, label: key, unit, digits: unit === "d" ? 3 : 1, ink: "--curve-contrast", floor: null, least, set: "pose", also: { key: `true_${key}`, ink: "--truth" } });
/** All curves there are. `floor`: the axis begins there; `fixed`: the axis is this one; `least`: it is this wide at least. */
export const CURVES = [
  { key: "contrast_gain", label: "contrast gain", unit: "×", digits: 2, ink: "--curve-contrast", floor: null, least: 0.5, about: "Contrast at the estimated motion by contrast without motion" },
  { key: "overlap", label: "overlap", unit: "0 to 1", digits: 2, ink: "--curve-overlap", fixed: [0, 1], about: "Share of the window's edge pixels that the map explains" },
  { key: "event_rate_hz", label: "events", unit: "Mev/s", digits: 2, gain: 1e-6, ink: "--curve-events", floor: 0, least: 0.02, about: "Event rate" },
  { key: "occupied_px", label: "occupied", unit: "px", digits: 0, ink: "--curve-events", floor: 0, least: 100, set: "pixels", about: "Pixels with at least one event in the window: few where there is little texture" },
  { key: "score", label: "map score", unit: "0 to 1", digits: 2, ink: "--curve-score", fixed: [0, 1], about: "Agreement with the map: 1 perfect, 0 chance" },
  { key: "confidence", label: "confidence", unit: "0 to 1", digits: 2, ink: "--curve-score", fixed: [0, 1], about: "Chance that the pose is within 2 % of the plane distance" },
  { key: "error_percent", label: "position error", unit: "% d", digits: 2, ink: "--truth", floor: 0, least: 1, truth: true, about: "Distance from the truth in per cent of the plane distance, after alignment" },
  { key: "error_deg", label: "rotation error", unit: "°", digits: 2, ink: "--truth", floor: 0, least: 0.5, truth: true, about: "Angle to the truth after alignment" },
  ...["x", "y", "z"].map((key) => ({ ...axis(key, "d", 0.02), about: `Position along ${key}, estimate and truth, aligned` })),
  ...[["pitch", "x"], ["yaw", "y"], ["roll", "z"]].map(([key, about]) => ({ ...axis(key, "°", 1), about: `Rotation about ${about}, estimate and truth, aligned` })),
];
const APART = [
  { key: "apart_percent", label: "apart", unit: "% d", digits: 2, ink: "--dim", floor: 0, least: 1, compared: true },
  { key: "apart_deg", label: "apart", unit: "°", digits: 2, ink: "--dim", floor: 0, least: 0.5, compared: true },
];
const FIRST = ["contrast_gain", "overlap", "event_rate_hz"];
const WITH_TRUTH = [...FIRST, "error_percent", "error_deg"];
const WITHOUT_TRUTH = [...FIRST, "score", "confidence"];

export class Curves {
  #fetching = new Set();
  #known = new WeakMap(); // columns -> {set: windows known, ended}
  #chosen = null; // keys; null for what suits the session

  /** `problem(sentence)` says what went wrong. */
  constructor(state, timeline, problem) {
    Object.assign(this, { state, timeline, problem });
    const kept = (localStorage.getItem(KEY) ?? "").split(",").filter((key) => CURVES.some((curve) => curve.key === key));
    if (kept.length) this.#chosen = kept;
    const show = popover(byId("curves-button"), byId("curves-menu"), () => this.#list());
    this.toggle = () => show(byId("curves-menu").hidden);
    state.watch(["columns", "windows", "detail", "compared"], () => this.#apply());
  }

  /** The curves that are shown, in their order. */
  get shown() {
    const { detail, columns } = this.state;
    const suits = detail?.ground_truth && columns?.has("error_percent") ? WITH_TRUTH : WITHOUT_TRUTH;
    const keys = this.#chosen ?? suits;
    const own = CURVES.filter(({ key, truth }) => keys.includes(key) && !(truth && detail && !detail.ground_truth));
    return this.state.compared.length ? [...own, ...APART] : own;
  }

  #apply() {
    this.timeline.setLanes(this.shown);
    for (const set of new Set(this.shown.map((curve) => curve.set).filter(Boolean))) this.#fetch(set);
  }

  /** Fetches what is not known of a set; counting pixels takes the server several answers. */
  async #fetch(set) {
    const { session, columns, windows, live } = this.state;
    if (!columns?.count || !windows) return;
    const known = this.#known.get(columns) ?? {};
    this.#known.set(columns, known);
    // Poses are refined until the session ends: read once more then.
    const start = known[set]?.live && !live && set === "pose" ? 0 : (known[set]?.count ?? 0);
    const key = `${session} ${set}`;
    if (this.#fetching.has(key) || (start >= windows && known[set]?.live === live)) return;
    this.#fetching.add(key);
    try {
      const answer = await api.columns(session, start, set);
      const count = columns.put(answer);
      known[set] = { count, live };
    } catch (error) {
      this.problem(error.message);
      known[set] = { count: Infinity, live };
    } finally {
      this.#fetching.delete(key);
    }
    if (this.state.columns !== columns) return;
    this.timeline.setLanes(this.shown);
    if (known[set].count < this.state.windows) setTimeout(() => this.state.columns === columns && this.#apply(), AGAIN_MS);
  }

  #list() {
    const shown = this.shown.map(({ key }) => key);
    const truth = Boolean(this.state.detail?.ground_truth);
    const rows = CURVES.map(({ key, label, unit, about, truth: needs }) =>
      make("label", { class: "choice", title: about }, make("input", { type: "checkbox", value: key, checked: shown.includes(key), disabled: Boolean(needs) && !truth, on: { change: () => this.#choose() } }), make("span", {}, make("b", {}, label, make("small", { class: "dim" }, ` ${unit}`)))),
    );
    byId("curves-menu").replaceChildren(
      make("p", { class: "dim" }, "Curves of the timeline"),
      make("div", { class: "choices" }, ...rows),
      make("button", { on: { click: () => this.#reset() } }, make("b", {}, "As at first"), make("span", { class: "dim" }, "contrast, overlap, events and what is known of the error")),
    );
  }

  #choose() {
    const keys = [...byId("curves-menu").querySelectorAll("input:checked")].map(({ value }) => value);
    this.#chosen = keys.length ? keys : null;
    if (this.#chosen) localStorage.setItem(KEY, keys.join(","));
    else localStorage.removeItem(KEY);
    this.#apply();
  }

  #reset() {
    this.#chosen = null;
    localStorage.removeItem(KEY);
    this.#apply();
    this.#list();
    setText(byId("curves-button"), "curves");
  }
}
