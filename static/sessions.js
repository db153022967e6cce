// The list of sessions on the left: what it is, how well it went, and a sparkline of its states.

import { byId, make, themeColour } from "./dom.js";
import { amount, duration, fixed, megaRate, percent } from "./format.js";
import { address } from "./address.js";
import { branchesOf, tried } from "./branch.js";
import { BY_BADNESS, STATES } from "./status.js";

const SPARK = { width: 192, height: 12, calm: 4 };
const ORDER = ["initializing", "tracking", "weak", "lost", "relocalizing"];
const WORDS = { live: "live", incomplete: "incomplete", queued: "queued", starting: "starting", failed: "failed" };
const MEANINGS = { live: "Being tracked now", incomplete: "The run ended early: what was written is here", queued: "Waits for its turn", starting: "Its first window is on the way", failed: "The run ended before its first window" };
const STAGES = { simulating: "simulating", reading: "reading the recording", compiling: "getting ready" };
const WITHOUT_WINDOWS = { queued: "waits for its turn", starting: "getting ready", failed: "not tracked" };

export class Sessions {
  #rows = new Map();

  /** `manage(name)` opens a session's dialog; `act(name, action)` pauses, resumes or cancels its run. */
  constructor(state, { manage, act }) {
    Object.assign(this, { state, manage, act });
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
    byId("session-list").addEventListener("click", ({ target }) => target.closest("a") && drawer(false));
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
    const found = ordered(sessions).filter(({ name, recording, tags }) => `${name} ${recording} ${tags.join(" ")}`.toLowerCase().includes(wanted));
    none.hidden = found.length > 0;
    none.textContent = sessions.length ? `No session's name or tag holds “${wanted}”.` : "No sessions yet.";
    const { name: focused, act } = document.activeElement?.closest?.("#session-list") ? document.activeElement.dataset : {};
    list.replaceChildren(...found.map((entry) => this.#row(entry)));
    this.#mark();
    if (focused) list.querySelector(`${act ? `[data-act="${act}"]` : "a"}[data-name="${CSS.escape(focused)}"]`)?.focus();
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
    const tags = entry.tags.length ? make("span", { class: "tag-line" }, ...entry.tags.map((tag) => make("span", { class: "tag" }, tag))) : null;
    const origin = entry.origin && !entry.kept ? make("span", { class: "dim" }, `from window ${entry.origin.window}: ${tried(entry.origin)}`) : null;
    const row = make(
      "li",
      { class: entry.kept ? null : "trial" },
      make(
        "a",
        { href: address(entry.name, null), dataset: { name: entry.name }, title: entry.recording },
        make("span", { class: "name" }, make("b", {}, entry.name), badge),
        origin,
        make("span", { class: "dim number" }, about),
        make("span", { class: "dim number" }, tracked),
        tags,
        sparkline(entry.sparkline ?? [], `States over time: ${tracked}`),
      ),
      entry.windows ? make("button", { class: "plain more compare-button", title: `Compare ${entry.name} with the open session`, "aria-label": `Compare with ${entry.name}`, dataset: { name: entry.name, act: "compare" }, on: { click: () => this.compare(entry.name) } }, "⇄") : null,
      make("button", { class: "plain more", title: `Rename, tag, delete ${entry.name}`, "aria-label": `More about ${entry.name}`, dataset: { name: entry.name, act: "manage" }, on: { click: () => this.manage(entry.name) } }, "⋯"),
      entry.run ? this.#run(entry) : null,
    );
    this.#rows.set(entry.name, { key, row });
    return row;
  }

  /** What a run does, and the buttons to stop it. */
  #run({ name, run }) {
    const button = (act, words) => make("button", { dataset: { name, act }, "aria-label": `${words} ${name}`, on: { click: () => this.act(name, act) } }, words);
    if (run.state === "queued") {
      const words = run.before > 0 ? `waits, ${run.before} before it` : "is next";
      return make("div", { class: "run-line" }, make("span", { class: "dim number" }, words), button("cancel", "cancel"));
    }
    const tracks = run.stage === "tracking";
    const figures = [STAGES[run.stage] ?? run.stage];
    if (tracks) figures.splice(0, 1, run.state === "paused" ? "paused" : percent(run.share), megaRate(run.events_per_second), run.lag_s > 0.05 ? `${fixed(run.lag_s, 1)} s behind` : "keeps up");
    const paused = run.state === "paused";
    return make(
      "div",
      { class: "run-line" },
      make("progress", { "aria-label": `Progress of ${name}`, ...(Number.isFinite(run.share) ? { max: 1, value: run.share } : {}) }),
      make("span", { class: "dim number" }, figures.join(" · ")),
      tracks ? button(paused ? "resume" : "pause", paused ? "go on" : "pause") : null,
      button("cancel", "stop"),
    );
  }

  #mark() {
    for (const link of this.#links()) {
      if (link.dataset.name === this.state.session) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
  }
}

/** The sessions with the branches that are not kept behind the one they were tried from. */
function ordered(sessions) {
  const trials = new Set(sessions.filter(({ kept }) => !kept));
  const out = [];
  const add = (entry) => {
    out.push(entry);
    for (const branch of branchesOf(entry, [...trials])) if (trials.delete(branch)) add(branch);
  };
  for (const entry of sessions) if (entry.kept) add(entry);
  return [...out, ...trials];
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
