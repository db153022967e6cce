// The handle that makes the images wider or narrower, by pointer or by the arrow keys.

import { byId } from "./dom.js";

const KEY = "dvsviz-side";
const STEP = 24;

export function sideGrip() {
  const grip = byId("side-grip");
  const set = (pixels) => {
    const width = Math.round(Math.max(300, Math.min(innerWidth * 0.6, pixels)));
    document.documentElement.style.setProperty("--side", `${width}px`);
    grip.setAttribute("aria-valuenow", String(width));
    return width;
  };
  const keep = (pixels) => localStorage.setItem(KEY, String(set(pixels)));
  const now = () => grip.parentElement.getBoundingClientRect().width;
  grip.addEventListener("pointerdown", (event) => {
    grip.setPointerCapture(event.pointerId);
    document.body.classList.add("dragging");
  });
  grip.addEventListener("pointermove", (event) => {
    if (grip.hasPointerCapture(event.pointerId)) keep(innerWidth - event.clientX);
  });
  grip.addEventListener("lostpointercapture", () => document.body.classList.remove("dragging"));
  grip.addEventListener("dblclick", () => {
    localStorage.removeItem(KEY);
    document.documentElement.style.removeProperty("--side");
  });
  grip.addEventListener("keydown", (event) => {
    const move = { ArrowLeft: STEP, ArrowRight: -STEP }[event.key];
    if (move) keep(now() + move);
  });
  const kept = Number(localStorage.getItem(KEY));
  if (kept) set(kept);
}
