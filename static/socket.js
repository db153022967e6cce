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

/** 16 hex digits that name this tab, kept while it lives. */
export function tabId() {
  let id = sessionStorage.getItem("dvsviz-tab");
  // A duplicated tab copies sessionStorage and would share the playhead: only a reload keeps the id.
  if (!id || performance.getEntriesByType("navigation")[0]?.type !== "reload") {
    id = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");
    sessionStorage.setItem("dvsviz-tab", id);
  }
  return id;
}

/**
 * Events: `open`, `closed`, and one for each type of message (`sessions`, `grown`, `export`, `error`, `images`),
 * with the message in `detail`.
 */
export class Socket extends EventTarget {
  #socket = null;
  #tries = 0;
  #timer = 0;

  constructor(tab) {
    super();
    this.tab = tab;
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
    socket.onopen = () => {
      this.#tries = 0;
      this.#tell("open");
    };
    socket.onmessage = ({ data }) => {
      const message = typeof data === "string" ? JSON.parse(data) : decodeImages(data);
      this.#tell(message.type, message);
    };
    socket.onclose = () => {
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
