// The bar over the images: which are shown, for how long events are gathered, and which polarities.

import { byId, make, setText } from "./dom.js";
import { KINDS } from "./images.js";
import { popover } from "./popover.js";

const KEY = "dvsviz-images";
/** What one can gather, the shortest first; the first with whole windows is where one begins. */
const GATHERED = [
  ...[1, 2, 5, 10, 20, 50, 100, 200].map((ms) => ({ windows: 1, ms, text: `${ms} ms` })),
  ...[1, 2, 3, 5, 10, 20].map((windows) => ({ windows, ms: 0, text: windows === 1 ? "this window" : `${windows} windows` })),
];
const ONE_WINDOW = GATHERED.findIndex(({ windows, ms }) => windows === 1 && !ms);
const EVENTS = ["both", "on", "off"];

export class ImageBar {
  /** `ask()` has the images drawn anew. */
  constructor(state, images, ask) {
    Object.assign(this, { state, images, ask });
    this.select = byId("gathered");
    this.select.replaceChildren(...GATHERED.map(({ text }, i) => make("option", { value: i }, text)));
    this.select.value = ONE_WINDOW;
    this.select.addEventListener("change", () => this.#gathered());
    this.events = byId("only-events");
    this.events.addEventListener("change", () => this.#events());
    const show = popover(byId("kinds-button"), byId("kinds-menu"), () => this.#list());
    this.toggle = () => show(byId("kinds-menu").hidden);
    const kept = (localStorage.getItem(KEY) ?? "").split(",").filter(Boolean);
    if (kept.length) images.choose(kept);
    state.watch(["detail"], () => this.#list());
  }

  /** The next longer (1) or shorter (-1) time. */
  gather(by) {
    this.select.value = Math.max(0, Math.min(GATHERED.length - 1, Number(this.select.value) + by));
    this.#gathered();
  }

  nextEvents() {
    this.events.value = EVENTS[(EVENTS.indexOf(this.events.value) + 1) % EVENTS.length];
    this.#events();
  }

  #gathered() {
    const { windows, ms } = GATHERED[Number(this.select.value)];
    this.#set({ windows, ms });
  }

  #events() {
    this.#set({ events: this.events.value });
  }

  #set(change) {
    this.state.set({ drawn: { ...this.state.drawn, ...change } });
    this.select.classList.toggle("changed", Number(this.select.value) !== ONE_WINDOW);
    this.events.classList.toggle("changed", this.events.value !== "both");
    this.ask();
  }

  #list() {
    const { images, state } = this;
    setText(byId("kinds-count"), `${images.kinds.length} of ${KINDS.length}`);
    const known = Boolean(state.detail?.ground_truth);
    const rows = KINDS.map(({ kind, name, title, truth }) => {
      const box = make("input", { type: "checkbox", checked: images.kinds.includes(kind), value: kind, on: { change: () => this.#choose() } });
      return make("label", { class: "choice" }, box, make("span", {}, make("b", {}, name), make("span", { class: "dim" }, truth && state.detail && !known ? "This session has no ground truth" : title)));
    });
    const focused = document.activeElement?.value;
    byId("kinds-menu").replaceChildren(make("p", { class: "dim" }, "Side by side, of the window under the playhead"), ...rows);
    if (focused && !byId("kinds-menu").hidden) byId("kinds-menu").querySelector(`[value="${focused}"]`)?.focus();
  }

  #choose() {
    const chosen = [...byId("kinds-menu").querySelectorAll("input:checked")].map(({ value }) => value);
    this.images.choose(chosen);
    localStorage.setItem(KEY, this.images.kinds.join(","));
    this.#list();
    this.ask();
  }
}
