// Asks for the images of the playhead's window: at most two requests are under way, the newest wish waits,
// everything between is dropped.

const UNDER_WAY = 2;
const GIVEN_UP_MS = 2000;

export class Seeker {
  #wish = null;
  #sent = new Map(); // request -> time sent
  #request = 0;
  #timer = 0;

  /** `send(message)` says whether the line is open. */
  constructor(send) {
    this.send = send;
  }

  /** Number of the newest request. */
  get request() {
    return this.#request;
  }

  /** Number that the newest wish has, or will have when it is sent. */
  get newest() {
    return this.#request + (this.#wish ? 1 : 0);
  }

  /** Asks for a window; an older wish that was not sent is forgotten. */
  want(session, window, kinds, options) {
    this.#wish = { type: "seek", session, window, kinds, options };
    this.#pump();
  }

  /** An answer came: it and all requests before it are done, the server drops what was overtaken. */
  answered(request) {
    for (const number of this.#sent.keys()) if (number <= request) this.#sent.delete(number);
    this.#pump();
  }

  /** The line was closed or another session is shown: nothing is under way. */
  reset() {
    this.#sent.clear();
    this.#wish = null;
  }

  #pump() {
    const now = performance.now();
    for (const [number, time] of this.#sent) if (now - time > GIVEN_UP_MS) this.#sent.delete(number);
    if (!this.#wish) return;
    if (this.#sent.size >= UNDER_WAY) {
      clearTimeout(this.#timer);
      this.#timer = setTimeout(() => this.#pump(), GIVEN_UP_MS);
      return;
    }
    if (!this.send({ ...this.#wish, request: this.#request + 1 })) return;
    this.#sent.set(++this.#request, now);
    this.#wish = null;
  }
}
