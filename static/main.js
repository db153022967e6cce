// The composition root of the page: it opens sessions, moves the playhead and knows all parts.

import { address, readAddress, writeAddress } from "./address.js";
import * as api from "./api.js";
import { Columns } from "./columns.js";
import { byId, make, setText } from "./dom.js";
import { closeDoor, showBanner, showDoor, showEmpty } from "./door.js";
import { Exports } from "./exports.js";
import { Failures } from "./failures.js";
import { amount, clockTime, duration } from "./format.js";
import { Images, KINDS } from "./images.js";
import { listenToKeys, toggleHelp } from "./keys.js";
import { liveStrip } from "./live.js";
import { Numbers } from "./numbers.js";
import { listen } from "./pointer.js";
import { Scene } from "./scene.js";
import { Seeker } from "./seeker.js";
import { Sessions } from "./sessions.js";
import { Socket, tabId } from "./socket.js";
import { sideGrip } from "./side.js";
import { state } from "./state.js";
import { paintBadge, STATES } from "./status.js";
import { themes } from "./theme.js";
import { Timeline } from "./timeline.js";
import { Transport } from "./transport.js";

const socket = new Socket(tabId());
const seeker = new Seeker((message) => socket.send(message));
const timeline = new Timeline();
const images = new Images(shown);
const transport = new Transport(state, seek);
const failures = new Failures(state, byHand);
const scene = new Scene(state, (message) => socket.send(message));
const list = new Sessions(state);
const exporting = new Exports(state);
new Numbers(state);
const nextTheme = themes(() => {
  timeline.restyle();
  list.restyle();
});
sideGrip();
liveStrip(state, { follow, problem: flash });

let opening = 0; // counts opened sessions: answers for an older one are dropped
let growing = null; // the fetch of new windows that is under way
let waiting = []; // promises of the script interface: {request, resolve}

// Opening ------------------------------------------------------------------------------------------------

/** Opens a session at a window (null: where it is best to begin); resolves when its images are shown. */
async function open(name, window = null) {
  const mine = ++opening;
  transport.pause();
  seeker.reset();
  images.clear("loading");
  state.set({ session: name, detail: null, columns: null, windows: 0, window: 0, shown: null, values: null, live: false, following: false, progress: null, loop: null, problem: null });
  timeline.setLoop(null);
  timeline.show({ columns: null, detail: null }, true);
  showEmpty(null);
  socket.send({ type: "open", session: name });
  try {
    const detail = await api.session(name);
    const columns = new Columns(detail.statuses.map((status) => STATES[status]?.badness ?? 0));
    const answer = await api.columns(name, 0);
    if (mine !== opening) return;
    columns.append(answer);
    const live = detail.state === "live";
    state.set({ detail, columns, windows: columns.count, live });
    timeline.show(state, true);
    scene.prepare(detail.viser);
    if (!columns.count) return nothingYet(live);
    const first = window ?? (live ? columns.count - 1 : (detail.failures[0]?.worst ?? Math.floor(columns.count / 2)));
    if (live && window === null) state.set({ following: true });
    images.accept(seeker.request + 1);
    seek(Math.max(0, Math.min(columns.count - 1, first)), true);
    await arrived();
  } catch (error) {
    if (mine === opening) refuse(error, name);
  }
}

function nothingYet(live) {
  images.clear("");
  images.accept(seeker.request + 1);
  if (live) state.set({ following: true });
  showEmpty(live ? "Starting" : "No windows", live ? "The first window is on its way." : "This session holds no windows: its run ended before the first one.");
}

function refuse(error, name) {
  if (error.isDoor) return door("The server does not know this browser.");
  state.set({ problem: error.message });
  images.clear("");
  const what = error.status === 404 ? `There is no session called “${name}”` : "This session cannot be shown";
  showEmpty(what, error.status === 404 ? "It may have been renamed or moved. Choose another from the list." : error.message);
}

// The playhead -------------------------------------------------------------------------------------------

/** Moves the playhead and asks for the images; called by playing, following and everything below. */
function seek(window, force = false) {
  if (!state.windows || (window === state.window && !force)) return;
  state.set({ window });
  ask();
}

/** Moved by a person: a live session is not followed any longer. */
function byHand(window) {
  state.set({ following: false });
  seek(window);
  transport.restart();
}

function ask() {
  const kinds = images.large ? [images.large] : KINDS.map(({ kind }) => kind);
  seeker.want(state.session, state.window, kinds, { polarity: state.polarity, scale: 1 });
}

/** Images of a window are on the screen. */
function shown(message) {
  if (message.session !== state.session) return;
  state.set({ shown: message.window, values: message.values });
  window.dispatchEvent(new CustomEvent("dvsviz-shown", { detail: { window: message.window, at: performance.now() } }));
  const ready = waiting.filter(({ request }) => request <= message.request);
  waiting = waiting.filter(({ request }) => request > message.request);
  for (const { resolve } of ready) resolve();
}

/** Resolves when the newest request, or a later one, is on the screen. */
function arrived() {
  // The wish may not be sent yet: it will have the next number.
  return new Promise((resolve) => waiting.push({ request: seeker.newest, resolve }));
}

function follow() {
  if (!state.live) return;
  transport.pause();
  state.set({ following: true });
  seek(state.windows - 1);
}

// Growing ------------------------------------------------------------------------------------------------

function grown(message) {
  if (message.session !== state.session) return;
  if (message.progress) state.set({ progress: message.progress });
  if (message.windows > state.windows || message.state !== state.detail?.state) grow();
}

/** Fetches what a live session has more; one fetch at a time, at most a few a second. */
function grow() {
  growing ??= fetchMore().finally(() => {
    growing = null;
  });
}

async function fetchMore() {
  const mine = opening;
  const { session, columns } = state;
  if (!columns) return;
  try {
    const detail = await api.session(session);
    // At the end refined poses and errors of all windows are known: everything is read again.
    const answer = await api.columns(session, detail.state === "live" ? columns.count : 0);
    if (mine !== opening) return;
    columns.append(answer);
    const empty = !state.windows && columns.count > 0;
    const live = detail.state === "live";
    state.set({ detail, windows: columns.count, live });
    if (empty) showEmpty(null);
    timeline.show(state);
    if (state.following && columns.count) seek(columns.count - 1, empty);
    if (!live) state.set({ following: false, progress: null });
  } catch (error) {
    if (error.isDoor) door("The server does not know this browser any more.");
    else flash(error.message);
  }
  await new Promise((resolve) => setTimeout(resolve, 200));
}

// Messages -----------------------------------------------------------------------------------------------

socket.addEventListener("open", () => {
  state.set({ connected: true });
  showBanner(null);
  seeker.reset();
  if (!state.session) return;
  socket.send({ type: "open", session: state.session });
  socket.send({ type: "layers", layers: state.layers });
  if (state.windows) ask();
  if (state.live) grow();
});
socket.addEventListener("closed", async ({ detail: { tries } }) => {
  state.set({ connected: false });
  seeker.reset();
  if (tries < 2) return;
  showBanner("The server does not answer. This page comes back by itself when it does.");
  try {
    await api.sessions();
  } catch (error) {
    if (error.isDoor) door("The server was started anew and has a new token.");
  }
});
socket.addEventListener("sessions", ({ detail: { sessions } }) => listed(sessions));
socket.addEventListener("grown", ({ detail }) => grown(detail));
socket.addEventListener("export", ({ detail }) => exporting.take(detail));
socket.addEventListener("error", ({ detail }) => detail?.text && flash(detail.text));
socket.addEventListener("images", ({ detail }) => {
  seeker.answered(detail.request);
  if (detail.session === state.session) images.take(detail);
});

function listed(sessions) {
  const first = state.sessions === null;
  state.set({ sessions });
  if (!state.session && sessions.length) {
    const best = sessions.find(({ state: is }) => is === "live") ?? sessions[0];
    open(best.name);
  } else if (first && !sessions.length) {
    showEmpty("No sessions yet", "Track a recording, and it appears here while it is being tracked:", make("pre", {}, "dvsviz track RECORDING"), "A recording is an HDF5 file, a folder or a zip in the UZH format, or a simulated one: dvsviz simulate --out r.h5");
  }
}

let flashing = 0;
function flash(text) {
  showBanner(text);
  clearTimeout(flashing);
  flashing = setTimeout(() => state.connected && showBanner(null), 6000);
}

// What the header and the strip over the scene say ----------------------------------------------------------

state.watch(["session", "detail", "sessions"], () => {
  const entry = state.sessions?.find(({ name }) => name === state.session);
  setText(byId("title"), state.session ?? "");
  const parts = entry ? [entry.recording, `${entry.width}×${entry.height}`, duration(entry.duration_s), `${amount(entry.events)} events`] : [];
  if (state.detail?.state === "incomplete") parts.push("incomplete");
  setText(byId("subtitle"), parts.join(" · "));
  document.title = state.session ? `${state.session} · dvsviz` : "dvsviz";
});
state.watch(["window", "windows", "columns", "detail"], () => {
  const known = state.windows > 0;
  const status = known ? state.statusOf(state.window) : null;
  paintBadge(byId("where-status"), status);
  setText(byId("where-time"), known ? clockTime(state.timeOf(state.window), 3) : "");
  setText(byId("where-window"), known ? `window ${state.window} of ${state.windows}` : "");
  timeline.setPlayhead(state.window);
  const box = byId("timeline");
  box.setAttribute("aria-valuemax", String(Math.max(0, state.windows - 1)));
  box.setAttribute("aria-valuenow", String(state.window));
  box.setAttribute("aria-valuetext", known ? `${clockTime(state.timeOf(state.window))}, window ${state.window} of ${state.windows}, ${status}` : "no session");
  if (known) writeAddress(state.session, state.window);
});
state.watch(["polarity"], () => byId("polarity").setAttribute("aria-pressed", String(state.polarity)));

// Hands --------------------------------------------------------------------------------------------------

listen(timeline, () => ({ columns: state.columns, detail: state.detail, statusOf: (window) => state.statusOf(window) }), {
  seek: byHand,
  loop: setLoop,
  rest: () => transport.restart(),
});

function setLoop(loop) {
  state.set({ loop });
  timeline.setLoop(loop);
}

function loopHere() {
  if (state.loop) return setLoop(null);
  const failure = state.failureAt(state.window);
  if (failure) setLoop({ start: failure.start, end: failure.end });
}

function toKeyframe(direction) {
  const keyframes = state.detail?.keyframes ?? [];
  const found = direction > 0 ? keyframes.find(({ window }) => window > state.window) : keyframes.findLast(({ window }) => window < state.window);
  if (found) byHand(found.window);
}

function step(windows) {
  state.set({ following: false });
  transport.step(windows);
}

function togglePolarity() {
  state.set({ polarity: !state.polarity });
  if (state.windows) ask();
}

function enlarge(kind) {
  images.enlarge(kind);
  if (state.windows) ask();
}

const zoomAt = (factor) => timeline.zoom(factor, state.timeOf(state.window) || 0);
byId("help-button").addEventListener("click", toggleHelp);
byId("polarity").addEventListener("click", togglePolarity);
byId("images").addEventListener("click", () => state.windows && ask());
listenToKeys({
  toggle: () => transport.toggle(),
  forward: () => step(1),
  back: () => step(-1),
  forwardTen: () => step(10),
  backTen: () => step(-10),
  first: () => (state.set({ following: false }), transport.jump(0)),
  last: () => (state.live ? follow() : transport.jump(state.windows - 1)),
  faster: () => transport.faster(1),
  slower: () => transport.faster(-1),
  nextFailure: () => failures.next(),
  previousFailure: () => failures.previous(),
  nextKeyframe: () => toKeyframe(1),
  previousKeyframe: () => toKeyframe(-1),
  filter: () => list.focusFilter(),
  ...Object.fromEntries(KINDS.map(({ kind }, i) => [`image${i + 1}`, () => enlarge(kind)])),
  polarity: togglePolarity,
  zoomIn: () => zoomAt(0.5),
  zoomOut: () => zoomAt(2),
  fit: () => timeline.fit(),
  follow: () => (state.following ? state.set({ following: false }) : follow()),
  loop: loopHere,
  exports: () => byId("export-button").click(),
  theme: nextTheme,
  help: toggleHelp,
  escape: () => setLoop(null),
});
addEventListener("hashchange", () => {
  const { token, session, window } = readAddress();
  if (token) return void enter(token).catch((error) => door(error.message));
  if (session && session !== state.session) open(session, window);
  else if (session && window !== null && window !== state.window) byHand(Math.max(0, Math.min(state.windows - 1, window)));
});

// Coming in ----------------------------------------------------------------------------------------------

/** Changes the token for a cookie and takes it out of the address bar, also when it is refused. */
async function enter(token) {
  const { session, window } = readAddress();
  history.replaceState(null, "", location.pathname + location.search + (session ? address(session, window) : ""));
  await api.login(token);
  closeDoor();
  await start();
}

function door(why) {
  transport.pause();
  socket.stop();
  showDoor(why, enter);
}

async function start() {
  const { session, window } = readAddress();
  const wanted = session ?? state.session;
  socket.connect();
  if (wanted) {
    state.set({ session: wanted });
    open(wanted, session ? window : state.windows ? state.window : null);
  }
  listed(await api.sessions());
}

// The script interface: for embedding and for tests.
window.dvsviz = {
  async open(session) {
    await open(session);
    if (state.problem) throw new Error(state.problem);
  },
  async seek(window) {
    if (!Number.isInteger(window) || window < 0 || window >= state.windows) throw new RangeError(`window: expected 0 to ${state.windows - 1}, got ${window}`);
    byHand(window);
    if (state.shown !== window) await arrived();
  },
  async play() {
    transport.play();
  },
  async pause() {
    transport.pause();
  },
  get state() {
    const { session, windows, window, shown, playing, speed, live, following } = state;
    return { session, windows, window, shown, status: windows ? state.statusOf(window) : null, playing, speed, live, following };
  },
};

const { token } = readAddress();
(token ? enter(token) : start()).catch((error) => {
  if (!error.isDoor) {
    showBanner("The server does not answer. This page comes back by itself when it does.");
    return void setTimeout(() => location.reload(), 3000);
  }
  door(token ? "The token in this address is not the one of the running server." : "The address holds no token, and this browser was not here before.");
});
