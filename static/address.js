// The fragment of the address: which session and window are open, and once, on arrival, the token.

const EVERY_MS = 300;
let timer = 0;
let latest = null;
let compared = [];

/** `{token, session, window}` as the address says; null where it does not. */
export function readAddress(text = location.hash) {
  const fields = new URLSearchParams(text.replace(/^#/, ""));
  const window = Number.parseInt(fields.get("window") ?? "", 10);
  const asked = [...fields.getAll("compare"), ...new URLSearchParams(location.search).getAll("compare")];
  return { token: fields.get("token"), session: fields.get("session"), window: Number.isInteger(window) ? window : null, compare: [...new Set(asked)] };
}

/** The fragment that opens a session at a window. */
export function address(session, window) {
  if (!session) return "#";
  return `#session=${encodeURIComponent(session)}${window === null ? "" : `&window=${window}`}`;
}

/** The sessions that stand in the address as compared, in place of a `?compare=` one came with. */
export function writeCompared(names) {
  compared = names;
  if (location.search) history.replaceState(null, "", location.pathname + location.hash);
  if (latest) writeAddress(...last);
}

let last = [null, null];

/** What was about to be written is dropped: the user has written an address. */
export function forgetAddress() {
  clearTimeout(timer);
  timer = 0;
}

/** Writes the address bar, at most every 300 ms: browsers refuse to be hurried. */
export function writeAddress(session, window, now = false) {
  last = [session, window];
  latest = address(session, window) + compared.map((name) => `&compare=${encodeURIComponent(name)}`).join("");
  if (now) clearTimeout(timer), (timer = 0);
  if (timer) return;
  const write = () => {
    timer = 0;
    if (location.hash !== latest) history.replaceState(null, "", location.pathname + location.search + (latest === "#" ? "" : latest));
  };
  if (now) write();
  else timer = setTimeout(write, EVERY_MS);
}
