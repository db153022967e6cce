// Asks for the images of the playhead's window: at most two requests are under way, the newest wish waits,
// everything between is dropped.

const UNDER_WAY = 2;
const GIVEN_UP_MS = 2000;
const AGAIN_MS = 3000; // an answer that did not come is asked for again

export class Seeker {
  #wish = null;
  #sent = new Map(); // request -> time sent
  #request = 0;
  #answered = 0;
  #timer = 0;
  #last = null; // the newest message that was sent
  #again = 0;

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
    this.#answered = Math.max(this.#answered, request);
    for (const number of this.#sent.keys()) if (number <= request) this.#sent.delete(number);
    this.#pump();
  }

  /** The line was closed or another session is shown: nothing is under way. */
  reset() {
    this.#sent.clear();
    this.#wish = null;
    this.#last = null;
    clearTimeout(this.#again);
  }

  /** Whether the answer to the newest message is still to come. */
  #isOpen() {
    return this.#last !== null && this.#answered < this.#request;
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
    this.#last = this.#wish;
    this.#wish = null;
    clearTimeout(this.#again);
    this.#again = setTimeout(() => {
      if (this.#isOpen() && !this.#wish) this.want(this.#last.session, this.#last.window, this.#last.kinds, this.#last.options);
    }, AGAIN_MS);
  }
}
