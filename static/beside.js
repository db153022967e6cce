// A branch beside the session it was tried from: its curves on the timeline, its path in the scene, how they differ.

import * as api from "./api.js";
import { Columns } from "./columns.js";
import { STATES } from "./status.js";

const BETWEEN_FETCHES_MS = 400;

export class Beside {
  name = null;
  columns = null;
  #busy = false;
  #again = false;

  /** `parts` are {state, socket, timeline}; `changed()` is called when there is something else to say. */
  constructor({ state, socket, timeline }, changed) {
    Object.assign(this, { state, socket, timeline, changed });
    socket.addEventListener("grown", ({ detail }) => detail.session === this.name && this.#fetch());
    socket.addEventListener("open", () => this.name && socket.send({ type: "beside", session: this.name }));
  }

  /** Shows a branch that was tried from a window; null shows none. */
  show(name, window = 0) {
    if (name === this.name) return;
    this.name = name;
    this.window = window;
    this.columns = null;
    this.timeline.setBeside(null);
    this.socket.send({ type: "beside", session: name });
    if (name) this.#fetch();
    this.changed();
  }

  /** The branch ended: refined poses and errors of all windows are known now. */
  ended() {
    this.#fetch();
  }

  async #fetch() {
    if (this.#busy) return void (this.#again = true);
    this.#busy = true;
    this.#again = false;
    const { name } = this;
    try {
      const answer = await api.columns(name, 0);
      if (name !== this.name) return;
      const columns = new Columns((this.state.detail?.statuses ?? []).map((status) => STATES[status]?.badness ?? 0));
      columns.append(answer);
      this.columns = columns;
      this.timeline.setBeside(columns, this.state.timeOf(this.window) || 0);
      this.changed();
    } catch {
      // It is not there yet, or not any more: the list of sessions says so.
    } finally {
      await new Promise((resolve) => setTimeout(resolve, BETWEEN_FETCHES_MS));
      this.#busy = false;
      if (this.#again && this.name) this.#fetch();
    }
  }

  /**
   * How session and branch do from a window of the session on, over the time that both cover:
   * `{windows, before: {tracked, percent, deg}, after: {…}}`, or null while nothing is known.
   */
  difference(window) {
    const mine = this.state.columns;
    const other = this.columns;
    if (!mine?.count || !other?.count) return null;
    const start = mine.get("t_s")[window];
    const first = other.firstAt(start - 1e-6);
    if (first >= other.count) return null;
    const end = Math.min(mine.get("t_s")[mine.count - 1], other.get("t_s")[other.count - 1]);
    return { windows: other.count - first, before: this.#figures(mine, start, end), after: this.#figures(other, start, end) };
  }

  #figures(columns, start, end) {
    const from = columns.firstAt(start - 1e-6);
    const to = columns.firstAt(end + 1e-6);
    const good = ["tracking", "weak"].map((name) => this.state.detail.statuses.indexOf(name));
    const status = columns.get("status");
    let tracked = 0;
    for (let i = from; i < to; i++) tracked += good.includes(status[i]);
    return { tracked: to > from ? tracked / (to - from) : NaN, percent: median(columns.get("error_percent"), from, to), deg: median(columns.get("error_deg"), from, to) };
  }
}

function median(values, from, to) {
  const known = [...values.subarray(from, to)].filter(Number.isFinite).sort((a, b) => a - b);
  return known.length ? known[known.length >> 1] : NaN;
}
