// Calls to the server. Every refusal becomes an ApiError with the server's own sentence.

export class ApiError extends Error {
  constructor(message, status) {
    super(message);
    this.status = status;
  }

  /** The server does not know this browser: a token is needed. */
  get isDoor() {
    return this.status === 401 || this.status === 403;
  }
}

async function call(path, options = {}) {
  let answer;
  try {
    answer = await fetch(path, { credentials: "same-origin", cache: "no-store", ...options });
  } catch {
    throw new ApiError("The server does not answer.", 0);
  }
  if (answer.ok) return answer;
  const text = await answer.text();
  let sentence = "";
  try {
    sentence = JSON.parse(text).error;
  } catch {
    sentence = text.length < 200 ? text : "";
  }
  throw new ApiError(sentence || `The server answered ${answer.status}.`, answer.status);
}

const post = (path, body) =>
  call(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
const place = (name) => `/api/sessions/${encodeURIComponent(name)}`;

/** Changes the token for a cookie; 403 when it is not this server's. */
export const login = (token) => post("/api/login", { token });
export const sessions = async () => (await call("/api/sessions")).json();
/** What there is to know about a session, and the address of the 3-D scene of a tab. */
export const session = async (name, tab) => (await call(`${place(name)}?tab=${tab}`)).json();
/** Begins an export `{to, start_s, end_s}`; resolves to its id. */
export const startExport = async (name, wanted) => (await (await post(`${place(name)}/export`, wanted)).json()).id;
/** The bytes of a finished export. */
export const exported = async (id) => new Uint8Array(await (await call(exportAddress(id))).arrayBuffer());
/** The last `export` message of an export, for a page without a websocket. */
export const exportProgress = async (id) => (await call(`/api/exports/${encodeURIComponent(id)}/progress`)).json();
export const stopExport = (id) => post(`/api/exports/${encodeURIComponent(id)}/stop`, {});
export const exportAddress = (id) => `/api/exports/${encodeURIComponent(id)}`;
/** Sets a bookmark `{window, text}` or takes one away `{delete: number}`; resolves to those there are. */
export const bookmark = async (name, change) => (await (await post(`${place(name)}/bookmarks`, change)).json()).bookmarks;
/** Recordings that a run can be started on, and the settings there are. */
export const recordings = async () => (await call("/api/recordings")).json();
/** What is known of a recording: `{state: "reading", share}` until it was read. */
export const recording = async (id) => (await call(`/api/recordings/${encodeURIComponent(id)}`)).json();
export const startRun = async (body) => (await post("/api/runs", body)).json();
/** Tries a session again: `{window, config, pose}`; resolves to `{name}` of the branch. */
export const branch = async (name, body) => (await post(`${place(name)}/branch`, body)).json();
/** A window on the map from another pose: `{png, explained}`. */
export const preview = async (name, body) => (await post(`${place(name)}/preview`, body)).json();
/** Renames, keeps, tags, resumes or deletes: `{do, name, tags}`; resolves to its name then, null where it is gone. */
export const change = async (name, body) => (await (await post(`${place(name)}/change`, body)).json()).name;
export const run = (name, action) => post(`/api/runs/${encodeURIComponent(name)}`, { action });

/** Columns of a set (`state`, `pose`, `pixels`) from window `start` on: `{start, count, columns: {name: typed array}}`. */
export async function columns(name, start, set = "state", base = null) {
  const laid = base === null ? "" : `&in=${encodeURIComponent(base)}`;
  return decodeColumns(await (await call(`${place(name)}/columns?start=${start}&set=${set}${laid}`)).arrayBuffer());
}

/** How sessions differ from one of them, which is first: `[{name, windows, tracked_share, …}]`. */
export async function compare(name, others) {
  const asked = others.map((other) => `with=${encodeURIComponent(other)}`).join("&");
  return (await (await call(`${place(name)}/compare?${asked}`)).json()).sessions;
}

const TYPES = { f64: Float64Array, f32: Float32Array, u8: Uint8Array, i32: Int32Array, u32: Uint32Array };
const ALIASES = { float64: "f64", "<f8": "f64", f8: "f64", float32: "f32", "<f4": "f32", f4: "f32", uint8: "u8", "|u1": "u8", u1: "u8" };

/** Reads the binary answer: length, JSON header, then each column whole, all at multiples of 8 bytes. */
export function decodeColumns(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let offset = 4 + length;
  const columns = {};
  for (const { name, dtype, width = 1 } of header.columns) {
    const Type = TYPES[ALIASES[dtype] ?? dtype];
    columns[name] = new Type(buffer, offset, header.count * (width || 1));
    offset += Math.ceil((header.count * (width || 1) * Type.BYTES_PER_ELEMENT) / 8) * 8;
  }
  return { start: header.start, count: header.count, columns };
}
