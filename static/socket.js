// The websocket: JSON out, JSON and images in, and coming back by itself when the server was away.

const WAITS_MS = [250, 500, 1000, 2000, 4000];

/** Splits a binary message into its JSON header and one view of the bytes for each image. */
export function decodeImages(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  for (const image of header.images) {
    image.data = buffer.slice(offset, offset + image.bytes);
    offset += image.bytes;
  }
  return header;
}

const TAKEN = 4409; // another page, of which this tab is a copy, has the name

/** 16 hex digits that name this tab, kept while it lives; made anew when it is a copy of another tab. */
function tabId(anew = false) {
  let id = sessionStorage.getItem("dvsviz-tab");
  if (!id || anew) {
    id = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");
    sessionStorage.setItem("dvsviz-tab", id);
  }
  return id;
}

/**
 * Events: `open` (the server has greeted), `closed`, and one for each type of message (`sessions`, `grown`, `export`, `error`, `images`),
 * with the message in `detail`.
 */
export class Socket extends EventTarget {
  #socket = null;
  #tries = 0;
  #timer = 0;

  tab = tabId();

  /** Resolves when the server greets. */
  greeted() {
    return new Promise((resolve) => this.addEventListener("open", resolve, { once: true }));
  }

  get isOpen() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  connect() {
    clearTimeout(this.#timer);
    if (this.#socket && this.#socket.readyState <= WebSocket.OPEN) return;
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/ws?tab=${this.tab}`);
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    let greeted = false;
    socket.onmessage = ({ data }) => {
      if (!greeted) {
        greeted = true;
        this.#tries = 0;
        this.#tell("open");
      }
      const message = typeof data === "string" ? JSON.parse(data) : decodeImages(data);
      this.#tell(message.type, message);
    };
    socket.onclose = ({ code }) => {
      if (code === TAKEN) {
        this.tab = tabId(true);
        return this.connect();
      }
      const wait = WAITS_MS[Math.min(this.#tries++, WAITS_MS.length - 1)];
      this.#tell("closed", { tries: this.#tries });
      this.#timer = setTimeout(() => this.connect(), wait);
    };
  }

  /** Stops coming back (the server does not know this browser any more). */
  stop() {
    clearTimeout(this.#timer);
    if (this.#socket) this.#socket.onclose = null;
    this.#socket?.close();
  }

  /** Sends when the line is open; says whether it was. */
  send(message) {
    if (this.isOpen) this.#socket.send(JSON.stringify(message));
    return this.isOpen;
  }

  #tell(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }
}
