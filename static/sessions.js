// The list of sessions on the left: what it is, how well it went, and a sparkline of its states.

import { byId, make, themeColour } from "./dom.js";
import { amount, duration, percent } from "./format.js";
import { address } from "./address.js";
import { BY_BADNESS, STATES } from "./status.js";

const SPARK = { width: 192, height: 12, calm: 4 };
const ORDER = ["initializing", "tracking", "weak", "lost", "relocalizing"];
const WORDS = { live: "live", incomplete: "incomplete", queued: "queued", starting: "starting", failed: "failed" };
const MEANINGS = { live: "Being tracked now", incomplete: "The run ended early: what was written is here", queued: "Waits for its turn", starting: "Its first window is on the way", failed: "The run ended before its first window" };
const WITHOUT_WINDOWS = { queued: "waits for its turn", starting: "getting ready", failed: "not tracked" };

export class Sessions {
  #rows = new Map();

  constructor(state) {
    this.state = state;
    const filter = byId("filter");
    filter.addEventListener("input", () => this.#show());
    filter.addEventListener("keydown", (event) => {
      if (event.key === "Escape") (filter.value = ""), this.#show(), filter.blur();
      if (event.key === "ArrowDown" || event.key === "Enter") this.#links()[0]?.focus();
    });
    byId("session-list").addEventListener("keydown", (event) => {
      const move = { ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (!move) return;
      event.preventDefault();
      const links = this.#links();
      (links[links.indexOf(document.activeElement) + move] ?? filter).focus();
    });
    const toggle = byId("sessions-toggle");
    const drawer = (open) => {
      document.body.classList.toggle("drawer", open);
      toggle.setAttribute("aria-expanded", String(open));
    };
    toggle.addEventListener("click", () => drawer(!document.body.classList.contains("drawer")));
    document.addEventListener("pointerdown", ({ target }) => {
      if (!byId("sessions").contains(target) && !toggle.contains(target)) drawer(false);
    });
    byId("session-list").addEventListener("click", () => drawer(false));
    state.watch(["sessions"], () => this.#show());
    state.watch(["session"], () => this.#mark());
  }

  focusFilter() {
    document.body.classList.add("drawer");
    byId("filter").focus();
    byId("filter").select();
  }

  /** Colours changed. */
  restyle() {
    this.#rows.clear();
    this.#show();
  }

  #links() {
    return [...byId("session-list").querySelectorAll("a")];
  }

  #show() {
    const { sessions } = this.state;
    const none = byId("session-none");
    const list = byId("session-list");
    if (!sessions) {
      list.replaceChildren(...Array.from({ length: 3 }, () => make("li", { class: "skeleton", "aria-hidden": true })));
      return void (none.hidden = true);
    }
    const wanted = byId("filter").value.trim().toLowerCase();
    const found = sessions.filter(({ name, recording }) => `${name} ${recording}`.toLowerCase().includes(wanted));
    none.hidden = found.length > 0;
    none.textContent = sessions.length ? `No session's name holds “${wanted}”.` : "No sessions yet.";
    const focused = document.activeElement?.dataset?.name;
    list.replaceChildren(...found.map((entry) => this.#row(entry)));
    this.#mark();
    if (focused) this.#links().find((link) => link.dataset.name === focused)?.focus();
  }

  /** A row, made anew only when its entry changed: a growing session sends the list often. */
  #row(entry) {
    const key = JSON.stringify(entry);
    const old = this.#rows.get(entry.name);
    if (old?.key === key) return old.row;
    const badge = WORDS[entry.state] ? make("span", { class: `badge ${entry.state}-badge`, title: MEANINGS[entry.state] }, WORDS[entry.state]) : null;
    const losses = entry.losses ? ` · lost ${entry.losses === 1 ? "once" : `${entry.losses}×`}` : "";
    const about = entry.width ? `${entry.width}×${entry.height} · ${duration(entry.duration_s)} · ${amount(entry.events)} events` : entry.recording;
    const tracked = entry.windows ? `${percent(entry.tracked_share)} tracked${losses}` : WITHOUT_WINDOWS[entry.state] ?? "no windows yet";
    const row = make(
      "li",
      {},
      make(
        "a",
        { href: address(entry.name, null), dataset: { name: entry.name }, title: entry.recording },
        make("span", { class: "name" }, make("b", {}, entry.name), badge),
        make("span", { class: "dim number" }, about),
        make("span", { class: "dim number" }, tracked),
        sparkline(entry.sparkline ?? [], `States over time: ${tracked}`),
      ),
    );
    this.#rows.set(entry.name, { key, row });
    return row;
  }

  #mark() {
    for (const link of this.#links()) {
      if (link.dataset.name === this.state.session) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
  }
}

/** Bars of up to 64 states: the worse, the taller, so that colour is not needed. */
function sparkline(statuses, label) {
  const ratio = Math.max(2, devicePixelRatio || 1);
  const canvas = make("canvas", { width: SPARK.width * ratio, height: SPARK.height * ratio, class: "spark", role: "img", "aria-label": label });
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  const width = SPARK.width / 64;
  statuses.forEach((number, i) => {
    const state = STATES[ORDER[number]];
    if (!state) return;
    const height = SPARK.calm + ((SPARK.height - SPARK.calm) * state.badness) / (BY_BADNESS.length - 1);
    pen.fillStyle = themeColour(state.colour);
    pen.fillRect(i * width, SPARK.height - height, width - 0.6, height);
  });
  return canvas;
}
