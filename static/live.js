// The strip in the header for a session that is being written: how fast, how far behind, follow, pause, stop.

import { run } from "./api.js";
import { byId, make, setText } from "./dom.js";
import { fixed, megaRate, percent } from "./format.js";

/** Asks before something that cannot be taken back; resolves to whether it is wanted. */
export function ask(title, text, yes, no = "Keep going") {
  const dialog = byId("ask");
  dialog.replaceChildren(
    make("h2", { id: "ask-title" }, title),
    make("p", {}, text),
    make("form", { method: "dialog" }, make("button", { value: "no", autofocus: true }, no), make("button", { value: "yes", class: "danger" }, yes)),
  );
  dialog.returnValue = "no";
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true }));
}

/** `follow()` takes the playhead to the end and keeps it there; `problem(sentence)` says what went wrong. */
export function liveStrip(state, { follow, problem }) {
  const running = () => state.sessions?.find(({ name }) => name === state.session)?.run ?? null;
  const act = async (action) => {
    try {
      await run(state.session, action);
      return true;
    } catch (error) {
      problem(error.message);
      return false;
    }
  };
  byId("follow").addEventListener("click", () => (state.following ? state.set({ following: false }) : follow()));
  byId("run-pause").addEventListener("click", async () => {
    await act(running()?.state === "paused" ? "resume" : "pause");
  });
  byId("run-cancel").addEventListener("click", async () => {
    if (await ask("Stop this run?", "Tracking ends here. What was tracked so far stays, and tracking can be resumed.", "Stop the run")) await act("cancel");
  });
  state.watch(["session", "sessions"], () => {
    // A run that another program started cannot be paused from here.
    const run = running();
    const paused = run?.state === "paused";
    byId("run-pause").hidden = byId("run-cancel").hidden = !run;
    setText(byId("run-pause"), paused ? "go on" : "pause run");
    setText(byId("live-badge"), paused ? "paused" : "live");
  });
  state.watch(["live", "pose"], () => {
    const at = state.live && state.pose?.position;
    byId("live-pose").hidden = !at;
    setText(byId("live-pose"), at ? `camera at ${at.map((value) => fixed(value)).join(", ")} d` : "");
  });
  state.watch(["live", "progress", "following", "detail"], () => {
    byId("live").hidden = !state.live;
    byId("follow").setAttribute("aria-pressed", String(state.following));
    setText(byId("follow"), state.following ? "following" : "follow");
    const p = state.progress;
    const parts = [];
    if (Number.isFinite(p?.share)) parts.push(percent(p.share));
    if (Number.isFinite(p?.events_per_second)) parts.push(megaRate(p.events_per_second));
    if (Number.isFinite(p?.real_time_factor) && !p.stream) parts.push(`${fixed(p.real_time_factor, 1)}× real time`);
    if (Number.isFinite(p?.lag_s)) parts.push(p.stream ? `pose after ${fixed(1000 * p.lag_s, 0)} ms` : `${fixed(p.lag_s, 1)} s behind`);
    if (Number.isFinite(p?.latency_median_ms)) parts.push(`median ${fixed(p.latency_median_ms, 0)}, 95 % ${fixed(p.latency_p95_ms, 0)} ms`);
    if (Number.isFinite(p?.used_share)) parts.push(`${percent(p.used_share)} of the events used`);
    if (p?.stream === "lost") parts.splice(0, parts.length, p.notice ?? "the stream was lost");
    setText(byId("live-text"), parts.join(" · "));
  });
}
