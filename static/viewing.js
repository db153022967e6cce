// Viewing a session: opening it, moving the playhead, asking for images, keeping up while it grows.

import * as api from "./api.js";
import { Columns } from "./columns.js";
import { showEmpty } from "./door.js";
import { isWaiting, waitingWords } from "./waiting.js";
import { STATES } from "./status.js";

const BETWEEN_FETCHES_MS = 200;
const LATE = 400; // windows whose errors may still come
const AGAIN_UNKNOWN = "The server does not know this browser any more.";

export class Viewing {
  #opening = 0; // counts opened sessions: answers for an older one are dropped
  #again = false; // there is more to fetch after that
  #growing = null; // the fetch of new windows that is under way
  #painted = 0; // newest request whose images are on the screen
  #waiting = []; // promises of the script interface: {request, resolve, reject}

  /**
   * `parts` are {state, socket, seeker, images, transport, timeline, scene}; `door(why)` asks for the token,
   * `flash(sentence)` says what went wrong for a moment.
   */
  constructor(parts, { door, flash }) {
    Object.assign(this, parts, { door, flash });
  }

  /** Opens a session at a window (null: where it is best to begin); resolves when its images are shown. */
  async open(name, window = null) {
    const { state, images, timeline } = this;
    const mine = ++this.#opening;
    const entry = state.sessions?.find((session) => session.name === name);
    const waiting = isWaiting(entry);
    this.transport.pause();
    this.seeker.reset();
    images.clear(waiting ? "" : "loading");
    state.set({ session: name, waiting, detail: null, columns: null, windows: 0, window: 0, shown: null, values: null, live: false, following: false, progress: null, pose: null, loop: null, problem: null });
    timeline.setLoop(null);
    timeline.show({ columns: null, detail: null }, true);
    if (waiting) return showEmpty(...waitingWords(entry, state.sessions));
    showEmpty(null);
    try {
      const [detail, answer] = await Promise.all([api.session(name, this.socket.tab), api.columns(name, 0)]);
      if (mine !== this.#opening) return;
      this.socket.send({ type: "open", session: name });
      const columns = new Columns(detail.statuses.map((status) => STATES[status]?.badness ?? 0));
      columns.append(answer);
      const live = detail.state === "live";
      state.set({ detail, columns, windows: columns.count, live });
      timeline.show(state, true);
      this.scene.prepare(detail.viser);
      images.accept(this.seeker.request + 1);
      if (live && window === null) state.set({ following: true });
      if (!columns.count) return this.#nothingYet(live);
      const first = window ?? (live ? columns.count - 1 : (detail.failures[0]?.worst ?? Math.floor(columns.count / 2)));
      this.seek(Math.max(0, Math.min(columns.count - 1, first)), true);
      await this.arrived().catch(() => {}); // one window that cannot be drawn is said, the others can be seen
    } catch (error) {
      if (mine === this.#opening) this.#refuse(error, name);
    }
  }

  /** The list of sessions is another one: a run that is waited for may have begun its session. */
  listed() {
    const { state } = this;
    if (!state.waiting) return;
    const entry = state.sessions.find(({ name }) => name === state.session);
    if (!entry) return showEmpty("This run was stopped", "It ended before its first window. Choose a session from the list.");
    if (isWaiting(entry)) showEmpty(...waitingWords(entry, state.sessions));
    else this.open(state.session);
  }

  #nothingYet(live) {
    this.images.blank(live ? "waiting for the first window" : "no windows");
    showEmpty(live ? "Starting" : "No windows", live ? "The first window is on its way." : "This session holds no windows: its run ended before the first one.");
  }

  #refuse(error, name) {
    if (error.isDoor) return this.door(AGAIN_UNKNOWN);
    this.state.set({ problem: error.message });
    this.images.clear("");
    if (error.status === 404) showEmpty(`There is no session called “${name}”`, "It may have been renamed or moved. Choose another from the list.");
    else showEmpty("This session cannot be shown", error.message);
  }

  /** Moves the playhead and asks for the images; called by playing, following and by hand. */
  seek(window, force = false) {
    const { state } = this;
    if (!state.windows || (window === state.window && !force)) return;
    state.set({ window });
    this.ask();
  }

  /** The playhead is moved by a person: a live session is not followed any longer. */
  byHand(window) {
    this.state.set({ following: false });
    this.seek(Math.max(0, Math.min(this.state.windows - 1, window)));
    this.transport.restart();
  }

  /** Asks for the images of the playhead's window. */
  ask() {
    const { state, images } = this;
    if (!state.windows) return;
    this.seeker.want(state.session, state.window, images.asked, { polarity: state.polarity, scale: 1, ...state.drawn });
  }

  /** Images of a window are on the screen. */
  shown(message) {
    if (message.session !== this.state.session) return;
    this.#painted = message.request;
    this.state.set({ shown: message.images.length ? message.window : null, values: message.values });
    if (message.request >= this.seeker.request) this.scene.release();
    window.dispatchEvent(new CustomEvent("dvsviz-shown", { detail: { window: message.window, at: performance.now() } }));
    const ready = this.#waiting.filter(({ request }) => request <= message.request);
    this.#waiting = this.#waiting.filter(({ request }) => request > message.request);
    for (const { resolve } of ready) resolve();
  }

  /** Resolves when the newest request, or a later one, is on the screen. */
  arrived() {
    const request = this.seeker.newest;
    if (this.#painted >= request) return Promise.resolve();
    return new Promise((resolve, reject) => this.#waiting.push({ request, resolve, reject }));
  }

  /** The server could not draw what was asked for. */
  failed(request, why) {
    this.scene.release();
    const over = this.#waiting.filter((waiting) => waiting.request <= request);
    this.#waiting = this.#waiting.filter((waiting) => waiting.request > request);
    for (const { reject } of over) reject(new Error(why));
  }

  /** Takes the playhead to the end of a live session and keeps it there. */
  follow() {
    const { state } = this;
    if (!state.live) return;
    this.transport.pause();
    state.set({ following: true });
    this.seek(state.windows - 1);
  }

  /** Takes a `grown` message. */
  grown(message) {
    const { state } = this;
    if (message.session !== state.session) return;
    if (message.progress) state.set({ progress: message.progress });
    const { state: before, recording_found: found } = state.detail ?? {};
    if (message.windows > state.windows || message.state !== before || message.recording_found !== found) this.grow();
  }

  /** Fetches what a live session has more; one fetch at a time, at most a few a second. */
  grow() {
    if (this.#growing) return void (this.#again = true);
    this.#growing = this.#fetchMore().finally(() => {
      this.#growing = null;
      // What was told meanwhile may be newer than what was fetched: the session's end, above all.
      if (this.#again) this.grow();
    });
    this.#again = false;
  }

  async #fetchMore() {
    const { state } = this;
    const mine = this.#opening;
    const { session, columns } = state;
    if (!columns) return;
    try {
      const detail = await api.session(session, this.socket.tab);
      const live = detail.state === "live";
      // The errors of the last windows come late; at the end refined poses and errors of all windows are known.
      const answer = await api.columns(session, !live ? 0 : detail.ground_truth ? columns.knownTo("error_percent", LATE) : columns.count);
      if (mine !== this.#opening) return;
      columns.append(answer);
      const first = !state.windows && columns.count > 0;
      const moved = !live || detail.map_revisions.length !== state.detail?.map_revisions.length || detail.recording_found !== state.detail?.recording_found;
      state.set({ detail, windows: columns.count, live });
      if (first) showEmpty(null);
      this.timeline.show(state);
      if (columns.count && (state.following || first)) this.seek(columns.count - 1, first || moved);
      else if (moved) this.ask(); // the poses were refined, the map is another one
      if (!live) state.set({ following: false, progress: null, pose: null });
    } catch (error) {
      if (error.isDoor) this.door(AGAIN_UNKNOWN);
      else this.flash(error.message);
    }
    await new Promise((resolve) => setTimeout(resolve, BETWEEN_FETCHES_MS));
  }
}
