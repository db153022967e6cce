// Lets the page's own work go before frames of the 3-D scene, where those are drawn by the processor: a frame takes
// 100 ms then, the scene shares the page's thread, viser draws several after each change, and between two of them the
// browser does not always let a message in. Measured: of 60 seeks a twentieth waited for two or three frames.
//
// A frame waits while images are under way, and after each frame the page has as long a time as the frame took.

const LONGEST_WAIT_MS = 150; // while images come without end (playing, dragging) the scene moves all the same
const LONGEST_REST_MS = 120;
const IN_HAND_MS = 1000; // after the pointer moved in the scene its frames do not wait: what is dragged follows the hand

export class FrameGate {
  #heldSince = null; // when images were asked for that are not painted
  #restUntil = 0;
  #calls = new Map(); // number -> callback that waits for a frame
  #number = 0;
  #inHandUntil = 0;
  #under = false;
  #timer = 0;
  #frame;
  #now = () => performance.now();

  /** Takes the place of a frame's `requestAnimationFrame`; `window` is that of the scene. */
  constructor(window) {
    this.window = window;
    this.#frame = window.requestAnimationFrame.bind(window);
    window.requestAnimationFrame = (call) => {
      this.#calls.set(++this.#number, call);
      this.#pump();
      return this.#number;
    };
    window.cancelAnimationFrame = (number) => this.#calls.delete(number);
    for (const event of ["pointermove", "pointerdown", "wheel"]) {
      window.addEventListener(event, () => this.#take(), { capture: true, passive: true });
    }
  }

  #take() {
    this.#inHandUntil = this.#now() + IN_HAND_MS;
    this.#pump();
  }

  /** Images are under way: frames wait. */
  hold() {
    this.#heldSince ??= this.#now();
  }

  /** They are on the screen, or will not come. */
  release() {
    this.#heldSince = null;
    this.#pump();
  }

  /** How long (ms) a frame has to wait yet. */
  #wait() {
    const now = this.#now();
    if (now < this.#inHandUntil) return 0;
    const held = this.#heldSince === null ? 0 : this.#heldSince + LONGEST_WAIT_MS - now;
    return Math.max(0, held, this.#restUntil - now);
  }

  #pump() {
    if (this.#under || !this.#calls.size) return;
    clearTimeout(this.#timer);
    const wait = this.#wait();
    if (wait > 0) return void (this.#timer = setTimeout(() => this.#pump(), wait));
    this.#under = true;
    this.#frame((time) => this.#draw(time));
  }

  #draw(time) {
    if (this.#wait() > 0) {
      this.#under = false; // a seek came meanwhile
      return this.#pump();
    }
    const calls = [...this.#calls.values()];
    this.#calls.clear();
    const from = this.#now();
    for (const call of calls) {
      try {
        call(time);
      } catch (error) {
        this.window.reportError(error);
      }
    }
    // What is drawn is waited for after the callbacks: the turn after them ends when the frame is done.
    setTimeout(() => this.#drawn(from));
  }

  #drawn(from) {
    const now = this.#now();
    this.#restUntil = now + Math.min(now - from, LONGEST_REST_MS);
    if (this.#heldSince !== null) this.#heldSince = now; // the next frame waits anew
    this.#under = false;
    this.#pump();
  }
}
