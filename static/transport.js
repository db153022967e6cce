// Playing: a monotonic clock says which window is due. A slow machine skips windows; time is never stretched.

import { byId, make, setText } from "./dom.js";
import { clockTime } from "./format.js";
import { STATES } from "./status.js";

export const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 4, 8, 16];

export class Transport {
  #frame = 0;
  #from = { clock: 0, seconds: 0 };

  /** `seek(window)` moves the playhead. */
  constructor(state, seek) {
    this.state = state;
    this.seek = seek;
    byId("speed").replaceChildren(...SPEEDS.map((speed) => make("option", { value: speed }, `${speed}×`)));
    byId("speed").addEventListener("change", () => this.setSpeed(Number(byId("speed").value)));
    const buttons = { first: () => this.jump(0), back: () => this.step(-1), play: () => this.toggle(), forward: () => this.step(1), last: () => this.jump(state.windows - 1) };
    for (const [id, press] of Object.entries(buttons)) byId(id).addEventListener("click", press);
    byId("legend").replaceChildren(
      ...Object.entries(STATES).map(([name, { letter, meaning }]) =>
        make("li", { title: `${name}: ${meaning}` }, make("i", { class: "swatch", dataset: { state: name } }, letter), name),
      ),
    );
    state.watch(["playing"], () => this.#showPlaying());
    state.watch(["speed"], () => (byId("speed").value = String(state.speed)));
    state.watch(["window", "columns", "windows"], () => this.#showClock());
  }

  play() {
    const { windows, window, loop } = this.state;
    if (!windows) return;
    const end = loop ? loop.end - 1 : windows - 1;
    if (window >= end || (loop && window < loop.start)) this.seek(loop ? loop.start : 0);
    this.state.set({ playing: true, following: false });
    this.#start();
  }

  pause() {
    cancelAnimationFrame(this.#frame);
    this.state.set({ playing: false });
  }

  toggle() {
    if (this.state.playing) this.pause();
    else this.play();
  }

  step(windows) {
    this.pause();
    this.jump(this.state.window + windows);
  }

  /** Goes to a window; when playing, playing goes on from there. */
  jump(window) {
    this.seek(Math.max(0, Math.min(this.state.windows - 1, window)));
    this.restart();
  }

  /** The playhead was moved by hand: the clock starts anew there. */
  restart() {
    if (this.state.playing) this.#start();
  }

  setSpeed(speed) {
    this.state.set({ speed });
    this.restart();
  }

  faster(direction) {
    const i = SPEEDS.findIndex((speed) => speed >= this.state.speed) + direction;
    this.setSpeed(SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, i))]);
  }

  #start() {
    cancelAnimationFrame(this.#frame);
    this.#from = { clock: performance.now(), seconds: this.state.timeOf(this.state.window) };
    this.#frame = requestAnimationFrame(() => this.#tick());
  }

  #tick() {
    const { state } = this;
    if (!state.playing || !state.columns) return;
    const { clock, seconds } = this.#from;
    const due = seconds + ((performance.now() - clock) / 1000) * state.speed;
    const end = state.loop ? state.loop.end - 1 : state.windows - 1;
    const window = Math.min(end, state.columns.windowAt(due));
    if (window !== state.window) this.seek(window);
    const over = window >= end && due >= state.timeOf(end) + 0.03;
    if (over && state.loop) {
      this.seek(state.loop.start);
      return this.#start();
    }
    // At the end of a session that grows, playing waits for more.
    if (over && !state.live) return this.pause();
    this.#frame = requestAnimationFrame(() => this.#tick());
  }

  #showPlaying() {
    const button = byId("play");
    button.setAttribute("aria-pressed", String(this.state.playing));
    setText(byId("play-word"), this.state.playing ? "Pause" : "Play");
  }

  #showClock() {
    const { window, windows, columns, detail } = this.state;
    for (const id of ["first", "back", "play", "forward", "last"]) byId(id).disabled = !windows;
    const whole = Math.max(detail?.duration_s ?? 0, windows ? this.state.timeOf(windows - 1) : 0);
    setText(byId("clock"), columns?.count ? `${clockTime(this.state.timeOf(window), 2)} / ${clockTime(whole, 2)}` : "");
  }
}
