// A run whose session is not there yet: what it is doing, in the place of the 3-D scene.

import { make } from "./dom.js";
import { percent } from "./format.js";

const WAITING = ["queued", "starting", "failed"];
const STEPS = {
  simulating: ["Make the demo recording", "Ten seconds of a wall with shapes, simulated once and kept."],
  reading: ["Read the recording", "Formats other than dvsviz's own are converted once and kept."],
  compiling: ["Get the tracker ready", "The first time on a machine its kernels are compiled, which takes about a minute; later a few seconds."],
  tracking: ["Track", "Poses, map and images appear here while it works."],
};

/** Whether an entry of the list of sessions has no session to open. */
export const isWaiting = (entry) => WAITING.includes(entry?.state);

/** Title and lines for such an entry. */
export function waitingWords(entry, entries) {
  if (entry.state === "failed") return [`“${entry.name}” could not be tracked`, entry.error];
  if (entry.state === "queued") {
    const before = entries.filter(({ state }) => state === "starting" || state === "live");
    return [`“${entry.name}” waits for its turn`, before.length ? `It begins when ${before.map(({ name }) => name).join(", ")} has ended.` : "It begins in a moment."];
  }
  const stages = entry.stages ?? ["reading", "compiling", "tracking"];
  const now = stages.indexOf(entry.stage);
  const steps = stages.map((stage, i) => {
    const [name, about] = STEPS[stage];
    const state = i < now ? "done" : i === now ? "now" : "next";
    const known = i === now && Number.isFinite(entry.share);
    const bar = i === now && stage !== "tracking" ? make("progress", { "aria-label": name, ...(known ? { max: 1, value: entry.share } : {}) }) : null;
    const words = known ? `${about} ${percent(entry.share)}` : about;
    return make("li", { dataset: { step: state }, ...(i === now ? { "aria-current": "step" } : {}) }, make("b", {}, name), make("span", { class: "dim" }, words), bar);
  });
  return [`Starting “${entry.name}”`, make("ol", { class: "steps" }, ...steps)];
}
