// What the page shows, in one place. Parts read it and are told which of its keys changed.

const START = {
  sessions: null,      // list of sessions, null while it is loading
  session: null,       // name of the open session
  detail: null,        // GET /api/sessions/NAME
  columns: null,       // Columns of the open session
  windows: 0,          // windows known
  window: 0,           // playhead
  shown: null,         // window whose images are on the screen
  values: null,        // numbers of the shown window
  playing: false,
  speed: 1,
  waiting: false,      // its run has not begun the session yet
  live: false,         // the session is being written
  following: false,    // the playhead stays at the end
  progress: null,      // of the run that writes it
  pose: null,          // {window, status, position} that a stream was at last, before it is in the session
  loop: null,          // {start, end} windows that are played again and again
  connected: true,
  problem: null,       // a sentence, while the session cannot be shown
  layers: { map: true, trajectory: true, keyframes: true, truth: true, frustum: true },
  polarity: true,
  compared: [], // sessions beside the open one: {name, columns, ink, shift}
  drawn: { windows: 1, ms: 0, events: "both" }, // which events the images hold
};

class State {
  #values = { ...START };
  #watchers = [];

  constructor() {
    for (const key of Object.keys(START)) Object.defineProperty(this, key, { get: () => this.#values[key], enumerable: true });
  }

  /** Changes several keys at once and tells those who watch one of them. */
  set(patch) {
    const changed = Object.keys(patch).filter((key) => !Object.is(this.#values[key], patch[key]));
    if (!changed.length) return;
    Object.assign(this.#values, patch);
    for (const { keys, tell } of this.#watchers) if (changed.some((key) => keys.includes(key))) tell(this);
  }

  /** Calls `tell(state)` now and after a change of one of the keys. */
  watch(keys, tell) {
    this.#watchers.push({ keys, tell });
    tell(this);
  }

  /** Status name of a window, or null. */
  statusOf(window) {
    const number = this.columns?.get("status")?.[window];
    return number === undefined ? null : (this.detail?.statuses?.[number] ?? null);
  }

  /** Seconds from the first event at which a window starts. */
  timeOf(window) {
    return this.columns?.get("t_s")?.[window] ?? NaN;
  }

  /** The failure a window belongs to, or null. */
  failureAt(window) {
    return this.detail?.failures?.find((failure) => failure.start <= window && window < failure.end) ?? null;
  }
}

export const state = new State();
