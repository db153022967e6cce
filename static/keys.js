// The keyboard. The same table is what the help shows.

import { byId, make } from "./dom.js";

/** Groups of `[keys, what it does, action name]`; a key with `shift+` in front wants the shift key. */
const KEYS = [
  ["Move", [
    [[" "], "play or pause", "toggle"],
    [["ArrowRight"], "one window on", "forward"],
    [["ArrowLeft"], "one window back", "back"],
    [["shift+ArrowRight"], "ten windows on", "forwardTen"],
    [["shift+ArrowLeft"], "ten windows back", "backTen"],
    [["Home"], "first window", "first"],
    [["End"], "last window", "last"],
    [["]"], "faster", "faster"],
    [["["], "slower", "slower"],
  ]],
  ["Find", [
    [["n"], "next failure", "nextFailure"],
    [["p"], "previous failure", "previousFailure"],
    [["w"], "why: explain this failure's cause", "why"],
    [["k"], "next keyframe", "nextKeyframe"],
    [["shift+K"], "previous keyframe", "previousKeyframe"],
    [["b"], "bookmark this window", "bookmark"],
    [["/"], "filter sessions", "filter"],
  ]],
  ["See", [
    [["1"], "enlarge the first image; 2 to 7 the others", "image1"],
    ...[2, 3, 4, 5, 6, 7].map((i) => [[String(i)], null, `image${i}`]),
    [["i"], "choose the images", "kinds"],
    [[","], "gather events for shorter", "gatherLess"],
    [["."], "gather events for longer", "gatherMore"],
    [["x"], "on and off, on only, off only", "onlyEvents"],
    [["c"], "polarity in two colours", "polarity"],
    [["m"], "compare with another session", "compare"],
    [["u"], "choose the curves", "curves"],
    [["g"], "landscape of the objective", "landscape"],
    [["+", "="], "zoom in on the playhead", "zoomIn"],
    [["-"], "zoom out", "zoomOut"],
    [["0"], "the whole session", "fit"],
    [["v"], "reset the view of the scene", "resetView"],
  ]],
  ["More", [
    [["f"], "follow a live session", "follow"],
    [["l"], "loop this failure, or end the loop", "loop"],
    [["r"], "track a recording", "track"],
    [["y"], "try again from this window", "tryAgain"],
    [["e"], "export", "exports"],
    [["t"], "dark, light, as the system", "theme"],
    [["?"], "these keys", "help"],
    [["Escape"], "close, end the loop", "escape"],
  ]],
];
const POINTER = [
  ["click or drag", "seek"],
  ["⇧ drag", "loop a stretch"],
  ["wheel", "zoom; sideways or with ⇧: pan"],
  ["double click", "the whole session"],
  ["alt drag", "pan"],
];
const NAMES = { " ": "space", ArrowRight: "→", ArrowLeft: "←", "shift+ArrowRight": "⇧ →", "shift+ArrowLeft": "⇧ ←", "shift+K": "⇧ K", Escape: "Esc" };
const LOOKUP = new Map(KEYS.flatMap(([, rows]) => rows.flatMap(([keys, , action]) => keys.map((key) => [key, action]))));

/** Calls `actions[name]()` for every key of the table. */
export function listenToKeys(actions) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const target = event.target;
    if (target.matches?.("input:not([type=range]), textarea, select") && event.key !== "Escape") return;
    // Space and arrows belong to the button or the tab that has the focus.
    if (event.key === " " && target.matches?.("button, a, summary")) return;
    if (event.key.startsWith("Arrow") && target.matches?.("[role=tab], [role=separator]")) return;
    if (document.querySelector("dialog[open]") && event.key !== "?") return;
    const action = LOOKUP.get(event.shiftKey && event.key.length > 1 ? `shift+${event.key}` : event.key) ?? LOOKUP.get(event.shiftKey ? `shift+${event.key}` : event.key.toLowerCase());
    if (!action || !actions[action]) return;
    event.preventDefault();
    actions[action]();
  });
}

/** Opens or closes the table of keys. */
export function toggleHelp() {
  const dialog = byId("help");
  if (dialog.open) return dialog.close();
  const list = (title, rows) =>
    make("section", {}, make("h3", {}, title), make("dl", {}, ...rows.flatMap(([keys, text]) => [make("dt", {}, ...keys.map((key) => make("kbd", {}, key))), make("dd", {}, text)])));
  dialog.replaceChildren(
    make("header", {}, make("h2", { id: "help-title" }, "Keys"), make("button", { autofocus: true, on: { click: () => dialog.close() } }, "Close")),
    make(
      "div",
      { class: "help-columns" },
      ...KEYS.map(([title, rows]) => list(title, rows.filter(([, text]) => text).map(([keys, text]) => [keys.map((key) => NAMES[key] ?? (key.length === 1 ? key.toUpperCase() : key)), text]))),
      list("On the timeline", POINTER.map(([key, text]) => [[key], text])),
    ),
  );
  dialog.showModal();
}
