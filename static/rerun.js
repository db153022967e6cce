// rerun's viewer at a window of a session: the recording is written, the viewer started, its time set, and stopped there.

import { exported, exportProgress, startExport } from "./api.js";
import { address } from "./address.js";
import { byId, setText } from "./dom.js";
import { setWindow, showRecording } from "./rerunviewer.js";

const POLL_MS = 200;
const query = new URLSearchParams(location.search);
const session = query.get("session") ?? "";
const at = Math.max(0, Number.parseInt(query.get("window") ?? "0", 10) || 0);
const chosen = ["dark", "light"].find((theme) => theme === localStorage.getItem("dvsviz-theme"));
if (chosen) document.documentElement.dataset.theme = chosen;

async function written() {
  const id = await startExport(session, { to: "rrd", reuse: true });
  for (;;) {
    const { share, done, error } = await exportProgress(id);
    if (error) throw new Error(error);
    byId("share").value = share;
    if (done) return exported(id);
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  }
}

async function started() {
  // A classic script's `let`: known to modules, but no property of the window.
  const viewer = typeof wasm_bindgen === "undefined" ? null : wasm_bindgen;
  if (!viewer) throw new Error("rerun's viewer did not come; see what the terminal of `dvsviz serve` says");
  await viewer({ module_or_path: "/rerun/re_viewer_bg.wasm" });
  return new viewer.WebHandle({
    // What an earlier tab left of panels and layout would hide the layout of the recording.
    persist: false,
    enable_history: false,
    hide_welcome_screen: true,
    render_backend: query.get("renderer"),
    theme: chosen ?? (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark"),
  });
}

async function show() {
  document.title = `${session} · window ${at} · rerun`;
  setText(byId("title"), `${session}, window ${at}`);
  byId("back").href = `/${address(session, at)}`;
  const [recording, handle] = await Promise.all([written(), started()]);
  setText(byId("stage"), "rerun's viewer reads it");
  byId("share").removeAttribute("value");
  await handle.start(byId("viewer"));
  // It loads and answers only while it draws: it has to be on the screen by now.
  document.body.classList.add("ready");
  showRecording(handle, recording, session);
  await setWindow(handle, at);
  // For scripts and tests: rerun's own handle, once it shows the window.
  window.rerun = handle;
}

show().catch((error) => {
  document.body.classList.remove("ready");
  document.body.classList.add("failed");
  setText(byId("stage"), String(error.message ?? error));
});
