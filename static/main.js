// The composition root of the page: it makes the parts and connects them.

import { address, forgetAddress, readAddress, writeAddress } from "./address.js";
import * as api from "./api.js";
import { Beside } from "./beside.js";
import { Branching } from "./branch.js";
import { Compare } from "./compare.js";
import { Curves } from "./curves.js";
import { byId, make, setText } from "./dom.js";
import { closeDoor, showBanner, showDoor, showEmpty } from "./door.js";
import { Exports } from "./exports.js";
import { Failures } from "./failures.js";
import { amount, clockTime, duration } from "./format.js";
import { ImageBar } from "./imagebar.js";
import { Images, KINDS } from "./images.js";
import { Landscape } from "./landscape.js";
import { listenToKeys, toggleHelp } from "./keys.js";
import { liveStrip } from "./live.js";
import { Manage } from "./manage.js";
import { Marks } from "./marks.js";
import { Numbers } from "./numbers.js";
import { listen } from "./pointer.js";
import { RunDialog } from "./runs.js";
import { Scene } from "./scene.js";
import { Seeker } from "./seeker.js";
import { Sessions } from "./sessions.js";
import { bottomGrip, sideGrip } from "./side.js";
import { Socket } from "./socket.js";
import { state } from "./state.js";
import { paintBadge } from "./status.js";
import { themes } from "./theme.js";
import { Timeline } from "./timeline.js";
import { Transport } from "./transport.js";
import { Viewing } from "./viewing.js";

const UNANSWERED = "The server does not answer. This page comes back by itself when it does.";
const FLASH_MS = 6000;
const RELOAD_MS = 3000;

const socket = new Socket();
const seeker = new Seeker((message) => {
  const isSent = socket.send(message);
  if (isSent) scene.hold();
  return isSent;
});
const timeline = new Timeline();
const images = new Images((message) => viewing.shown(message));
const transport = new Transport(state, (window) => viewing.seek(window));
const scene = new Scene(state, (message) => socket.send(message));
const viewing = new Viewing({ state, socket, seeker, images, transport, timeline, scene }, { door, flash });
const byHand = (window) => viewing.byHand(window);
const failures = new Failures(state, byHand);
const manage = new Manage(state, { gone: (name) => name === state.session && leave(state.detail?.origin?.session) });
const list = new Sessions(state, { manage: (name) => manage.open(name), act: (name, action) => api.run(name, action).catch((error) => flash(error.message)) });
const runDialog = new RunDialog({ started: (name) => (awaited = name) });
const beside = new Beside({ state, socket, timeline }, () => branching.show());
const branching = new Branching({ state, socket, beside }, { problem: flash, manage: (name) => manage.open(name) });
const exporting = new Exports(state, timeline);
new Numbers(state);
const imageBar = new ImageBar(state, images, () => viewing.ask());
const landscape = new Landscape(state, (message) => socket.send(message));
failures.look = () => landscape.isOpen || landscape.toggle();
const marks = new Marks(state, { seek: byHand, problem: flash });
const nextTheme = themes(() => {
  timeline.restyle();
  landscape.restyle();
  list.restyle();
});
sideGrip();
bottomGrip();
const curves = new Curves(state, timeline, flash);
const compare = new Compare({ state, timeline, socket }, { seek: byHand, problem: flash });
list.compare = (name) => compare.add(name);
liveStrip(state, { follow: () => viewing.follow(), problem: flash });

// Messages -----------------------------------------------------------------------------------------------

socket.addEventListener("open", () => {
  state.set({ connected: true });
  showBanner(null);
  seeker.reset();
  if (!state.session || state.waiting) return;
  socket.send({ type: "open", session: state.session });
  socket.send({ type: "layers", layers: state.layers });
  viewing.ask();
  if (state.live) viewing.grow();
});
socket.addEventListener("closed", async ({ detail: { tries } }) => {
  state.set({ connected: false });
  seeker.reset();
  if (tries < 2) return;
  showBanner(UNANSWERED);
  try {
    await api.sessions();
  } catch (error) {
    if (error.isDoor) door("The server was started anew and has a new token.");
  }
});
socket.addEventListener("sessions", ({ detail: { sessions } }) => listed(sessions));
socket.addEventListener("grown", ({ detail }) => viewing.grown(detail));
socket.addEventListener("pose", ({ detail }) => detail.session === state.session && state.set({ pose: detail }));
// A keyframe was clicked in the 3-D scene.
socket.addEventListener("goto", ({ detail }) => detail.session === state.session && byHand(detail.window));
socket.addEventListener("landscape", ({ detail }) => landscape.take(detail));
socket.addEventListener("renamed", ({ detail: { session, name } }) => {
  if (session !== state.session || state.live) return;
  if (name) viewing.open(name, state.window);
  else leave(state.detail?.origin?.session);
});
socket.addEventListener("export", ({ detail }) => exporting.take(detail));
socket.addEventListener("error", ({ detail }) => {
  if (!detail?.text) return;
  flash(detail.text);
  if (!Number.isInteger(detail.request)) return;
  seeker.answered(detail.request);
  viewing.failed(detail.request, detail.text);
});
socket.addEventListener("images", ({ detail }) => {
  seeker.answered(detail.request);
  if (detail.session === state.session) images.take(detail);
});

let awaited = null; // a run that was just started is opened as soon as it is listed

/** The session that is open is gone: its origin is shown, or the first there is. */
function leave(origin) {
  const left = state.sessions?.filter(({ name }) => name !== state.session) ?? [];
  const next = left.find(({ name }) => name === origin) ?? left[0];
  if (next) viewing.open(next.name);
  else showEmpty("No sessions any more", "Track a recording, and it appears here while it is being tracked.");
}

function listed(sessions) {
  const first = state.sessions === null;
  state.set({ sessions });
  if (awaited && sessions.some(({ name }) => name === awaited)) {
    viewing.open(awaited);
    awaited = null;
  }
  viewing.listed();
  if (!state.session && !readAddress().session && sessions.length) {
    const first = ["live", "starting", "queued"].map((wanted) => sessions.find(({ state: is }) => is === wanted));
    viewing.open((first.find(Boolean) ?? sessions[0]).name);
  } else if (first && !sessions.length) {
    showEmpty("No sessions yet", "Track a recording, and it appears here while it is being tracked:", make("pre", {}, "dvsviz track RECORDING"), "A recording is an HDF5 file, a folder or a zip in the UZH format, or a simulated one: dvsviz simulate --out r.h5");
  }
}

let flashing = 0;
function flash(text) {
  showBanner(text);
  clearTimeout(flashing);
  flashing = setTimeout(() => state.connected && showBanner(null), FLASH_MS);
}

// What the header and the strip over the scene say ----------------------------------------------------------

state.watch(["session", "detail", "sessions"], () => {
  const entry = state.sessions?.find(({ name }) => name === state.session);
  setText(byId("title"), state.session ?? "");
  const parts = entry?.width ? [entry.recording, `${entry.width}×${entry.height}`, duration(entry.duration_s), `${amount(entry.events)} events`] : [];
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
state.watch(["detail"], () => timeline.show(state)); // bookmarks came or went
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
  viewing.ask();
}

function enlarge(kind) {
  images.enlarge(kind);
  viewing.ask();
}

const zoomAt = (factor) => timeline.zoom(factor, state.timeOf(state.window) || 0);
byId("help-button").addEventListener("click", toggleHelp);
byId("polarity").addEventListener("click", togglePolarity);
byId("images").addEventListener("click", () => viewing.ask());
listenToKeys({
  toggle: () => transport.toggle(),
  forward: () => step(1),
  back: () => step(-1),
  forwardTen: () => step(10),
  backTen: () => step(-10),
  first: () => (state.set({ following: false }), transport.jump(0)),
  last: () => (state.live ? viewing.follow() : transport.jump(state.windows - 1)),
  faster: () => transport.faster(1),
  slower: () => transport.faster(-1),
  nextFailure: () => failures.next(),
  previousFailure: () => failures.previous(),
  why: () => failures.explain(),
  nextKeyframe: () => toKeyframe(1),
  previousKeyframe: () => toKeyframe(-1),
  bookmark: () => marks.begin(),
  filter: () => list.focusFilter(),
  ...Object.fromEntries(KINDS.map((_, i) => [`image${i + 1}`, () => images.kinds[i] && enlarge(images.kinds[i])])),
  kinds: () => imageBar.toggle(),
  gatherLess: () => imageBar.gather(-1),
  gatherMore: () => imageBar.gather(1),
  onlyEvents: () => imageBar.nextEvents(),
  polarity: togglePolarity,
  landscape: () => landscape.toggle(),
  curves: () => curves.toggle(),
  compare: () => compare.begin(),
  zoomIn: () => zoomAt(0.5),
  zoomOut: () => zoomAt(2),
  fit: () => timeline.fit(),
  resetView: () => scene.reset(),
  follow: () => (state.following ? state.set({ following: false }) : viewing.follow()),
  loop: loopHere,
  track: () => runDialog.open(),
  tryAgain: () => branching.begin(),
  exports: () => byId("export-button").click(),
  theme: nextTheme,
  help: toggleHelp,
  escape: () => setLoop(null),
});
addEventListener("hashchange", (event) => {
  const { token, session, window, compare: names } = readAddress(new URL(event.newURL).hash);
  forgetAddress();
  if (token) return void enter(token).catch((error) => door(error.message));
  compare.ask(names, session);
  if (session && session !== state.session) viewing.open(session, window);
  else if (session && window !== null && window !== state.window) byHand(window);
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
  await Promise.all([api.sessions(), socket.greeted()]);
  if (wanted) {
    state.set({ session: wanted });
    viewing.open(wanted, session ? window : state.windows ? state.window : null);
  }
}

// The script interface: for embedding and for tests.
window.dvsviz = {
  async open(session) {
    await viewing.open(session);
    if (state.problem) throw new Error(state.problem);
  },
  async seek(window) {
    if (!Number.isInteger(window) || window < 0 || window >= state.windows) throw new RangeError(`window: expected 0 to ${state.windows - 1}, got ${window}`);
    byHand(window);
    await viewing.arrived();
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
    showBanner(UNANSWERED);
    return void setTimeout(() => location.reload(), RELOAD_MS);
  }
  door(token ? "The token in this address is not the one of the running server." : "The address holds no token, and this browser was not here before.");
});
