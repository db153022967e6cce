// The failure sentence under the scene, and the panels that list failures, the log and how the session was made.

import { CAUSES, causeName } from "./causes.js";
import { byId, make, setText } from "./dom.js";
import { clockTime, duration, fixed, percent, whole } from "./format.js";
import { paintBadge } from "./status.js";

export class Failures {
  /** `seek(window)` moves the playhead. */
  constructor(state, seek) {
    this.state = state;
    this.seek = seek;
    this.cause = "";
    this.explained = null; // the failure whose cause is explained, by its first window
    byId("failure-why").addEventListener("click", () => this.explain());
    byId("failure-next").addEventListener("click", () => this.next());
    byId("failure-previous").addEventListener("click", () => this.previous());
    state.watch(["window", "detail", "columns", "problem", "session"], () => this.#sentence());
    state.watch(["detail"], () => this.#lists());
    for (const tab of document.querySelectorAll("[role=tab]")) {
      tab.addEventListener("click", () => this.#choose(tab));
      tab.addEventListener("keydown", (event) => {
        const move = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (!move) return;
        const tabs = [...document.querySelectorAll("[role=tab]")];
        const other = tabs[(tabs.indexOf(tab) + move + tabs.length) % tabs.length];
        this.#choose(other);
        other.focus();
      });
    }
  }

  /** To the worst window of the next failure; says whether there was one. */
  next() {
    const found = this.state.detail?.failures.find(({ worst }) => worst > this.state.window);
    if (found) this.seek(found.worst);
    return Boolean(found);
  }

  previous() {
    const found = this.state.detail?.failures.findLast(({ worst }) => worst < this.state.window);
    if (found) this.seek(found.worst);
    return Boolean(found);
  }

  /** Explains the cause of the failure one is in: the list is shown, opened at it. */
  explain() {
    const failure = this.state.failureAt(this.state.window);
    if (!failure) return;
    this.cause = "";
    this.explained = failure.start;
    this.#failureList(this.state.detail);
    byId("tab-failures").click();
    const opened = byId("panel-failures").querySelector("[aria-expanded=true]");
    opened?.scrollIntoView({ block: "nearest" });
    opened?.focus();
  }

  #choose(tab) {
    for (const other of document.querySelectorAll("[role=tab]")) {
      const chosen = other === tab;
      other.setAttribute("aria-selected", String(chosen));
      other.tabIndex = chosen ? 0 : -1;
      byId(other.getAttribute("aria-controls")).hidden = !chosen;
    }
  }

  #times({ start, end }) {
    const from = this.state.timeOf(start);
    const to = end < this.state.windows ? this.state.timeOf(end) : this.state.timeOf(this.state.windows - 1);
    return `${clockTime(from)} to ${clockTime(to)}`;
  }

  #sentence() {
    const { state } = this;
    const bar = byId("failure");
    const failures = state.detail?.failures ?? [];
    bar.hidden = !state.detail || Boolean(state.problem);
    if (bar.hidden) return;
    const failure = state.failureAt(state.window);
    const status = state.statusOf(state.window);
    paintBadge(byId("failure-badge"), status);
    byId("failure-next").disabled = !failures.some(({ worst }) => worst > state.window);
    byId("failure-previous").disabled = !failures.some(({ worst }) => worst < state.window);
    if (failure) {
      setText(byId("failure-title"), failure.message);
      setText(byId("failure-detail"), `${this.#times(failure)} · windows ${failure.start} to ${failure.end - 1}, worst ${failure.worst} · ${causeName(failure.cause)}`);
    } else {
      const next = failures.find(({ start }) => start > state.window);
      const calm = { initializing: "Looking for the first velocity and the plane", tracking: "Tracking", weak: "Weak: the pose is doubtful here", lost: "Lost", relocalizing: "Searching the map" }[status];
      setText(byId("failure-title"), calm ? `${calm}.` : "");
      const count = failures.length === 1 ? "1 failure in this session" : `${failures.length} failures in this session`;
      const ahead = next ? `; the next at ${clockTime(state.timeOf(next.start))}` : "";
      setText(byId("failure-detail"), failures.length ? count + ahead : state.live ? "No failure so far" : "No failure in this session");
    }
    bar.dataset.failure = failure ? "yes" : "";
    byId("failure-why").hidden = !failure;
    for (const row of byId("panel-failures").querySelectorAll("[data-start]"))
      row.setAttribute("aria-current", String(Number(row.dataset.start) <= state.window && state.window < Number(row.dataset.end)));
  }

  #lists() {
    const { detail } = this.state;
    setText(byId("tab-failures"), detail?.failures.length ? `Failures ${detail.failures.length}` : "Failures");
    this.#failureList(detail);
    this.#log(detail);
    this.#run(detail);
  }

  #failureList(detail) {
    const panel = byId("panel-failures");
    if (!detail?.failures.length) return panel.replaceChildren(make("p", { class: "dim hint" }, detail ? "No window was weak or lost for long." : ""));
    const causes = [...new Set(detail.failures.map(({ cause }) => cause))];
    if (!causes.includes(this.cause)) this.cause = "";
    const filter = make("select", { "aria-label": "Cause", on: { change: (event) => ((this.cause = event.target.value), this.#failureList(detail)) } }, make("option", { value: "" }, `all causes (${detail.failures.length})`), ...causes.map((cause) => make("option", { value: cause }, `${causeName(cause)} (${detail.failures.filter((f) => f.cause === cause).length})`)));
    filter.value = this.cause;
    const rows = detail.failures.filter(({ cause }) => !this.cause || cause === this.cause).map((failure) =>
      make("li", { class: "failure-row" }, make("button", { class: "row", dataset: { start: failure.start, end: failure.end }, on: { click: () => this.seek(failure.worst) } }, make("span", { class: "number dim" }, clockTime(this.state.timeOf(failure.start))), make("span", {}, failure.message)), this.#why(failure), this.explained === failure.start ? this.#explanation(failure) : null),
    );
    panel.replaceChildren(causes.length > 1 ? filter : "", make("ul", { class: "rows" }, ...rows));
  }

  /** The button that explains a failure's cause under it, or hides that. */
  #why({ start, cause }) {
    const open = this.explained === start;
    const toggle = () => {
      this.explained = open ? null : start;
      this.#failureList(this.state.detail);
      byId("panel-failures").querySelector(`[data-why="${start}"]`)?.focus();
    };
    return make("button", { class: "plain why", "aria-expanded": String(open), "aria-label": `Why: ${causeName(cause)}`, title: "What this cause means and what can be done", dataset: { why: start }, on: { click: toggle } }, "why?");
  }

  /** What a cause means, from what it is told, what can be done, and the way to the landscape of the worst window. */
  #explanation({ cause, worst }) {
    const { name, means, from, todo } = CAUSES[cause] ?? { name: causeName(cause), means: "This cause is not known to this page.", from: "–", todo: "–" };
    const look = make("button", { on: { click: () => (this.seek(worst), this.look()) } }, `Landscape at its worst window, ${worst}`);
    return make("div", { class: "explanation" }, make("h3", {}, name), make("p", {}, means), make("p", {}, make("b", {}, "Told from "), from), make("p", {}, make("b", {}, "What to do "), todo), make("p", {}, look));
  }

  #log(detail) {
    const rows = (detail?.log ?? []).map(({ window, level, text }) =>
      make("li", {}, make("button", { class: "row", dataset: { level }, on: { click: () => this.seek(window) } }, make("span", { class: "number dim" }, clockTime(this.state.timeOf(window))), make("span", {}, level === "info" ? "" : make("b", {}, `${level}: `), text))),
    );
    byId("panel-log").replaceChildren(rows.length ? make("ul", { class: "rows" }, ...rows) : make("p", { class: "dim hint" }, "The log of events is empty."));
  }

  #run(detail) {
    const panel = byId("panel-run");
    if (!detail) return panel.replaceChildren();
    const e = detail.evaluation;
    const rows = [
      ["windows", whole(detail.windows)],
      ["duration", duration(detail.duration_s)],
      ["sensor", `${detail.width} × ${detail.height} px`],
      ["keyframes", whole(detail.keyframes.length)],
      ["recording", detail.recording_found ? "found" : "not found: stored images only"],
    ];
    if (e) {
      rows.push(["alignment", e.alignment], ["position RMSE", `${fixed(e.position_rmse_percent_of_distance, 2)} % d · ${fixed(e.position_rmse_m, 4)} m`]);
      rows.push(["rotation RMSE", `${fixed(e.rotation_rmse_deg, 2)}°`], ["RPE over 1 s", `${fixed(e.rpe_position_m, 4)} m · ${fixed(e.rpe_rotation_deg, 2)}°`], ["path", `${fixed(e.path_m, 2)} m`], ["coverage", percent(e.coverage)]);
    }
    const s = detail.summary ?? {};
    if (Number.isFinite(s.real_time_factor)) rows.push(["real-time factor", fixed(s.real_time_factor, 2)]);
    if (Number.isFinite(s.metric_scale?.metres_per_unit)) rows.push(["a unit is", `${fixed(s.metric_scale.metres_per_unit, 3)} m ± ${percent(s.metric_scale.deviation)} by the accelerometer`]);
    if (Number.isFinite(s.tracked_share)) rows.push(["tracked", percent(s.tracked_share)]);
    if (Number.isFinite(s.losses)) rows.push(["losses", whole(s.losses)]);
    const settings = detail.config ? make("details", {}, make("summary", {}, "Settings"), make("pre", {}, JSON.stringify(typeof detail.config === "string" ? JSON.parse(detail.config) : detail.config, null, 2))) : "";
    panel.replaceChildren(make("dl", { class: "about number" }, ...rows.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)])), settings);
  }
}
