// The handles between the parts of the page: the images' width and the timeline's height, by pointer or by arrow keys.

import { byId } from "./dom.js";

const STEP = 24;
const MOST = 0.6; // of the page

/** Width of the images. */
export function sideGrip() {
  grip("side", { property: "--side", dragging: "dragging", more: "ArrowLeft", less: "ArrowRight", least: 300, whole: () => innerWidth, pointer: "clientX", size: "width" });
}

/** Height of the timeline. */
export function bottomGrip() {
  grip("bottom", { property: "--bottom-kept", dragging: "dragging-bottom", more: "ArrowUp", less: "ArrowDown", least: 150, whole: () => innerHeight, pointer: "clientY", size: "height" });
}

function grip(name, { property, dragging, more, less, least, whole, pointer, size }) {
  const element = byId(`${name}-grip`);
  const key = `dvsviz-${name}`;
  const keys = { [more]: STEP, [less]: -STEP };
  const set = (pixels) => {
    const bounded = Math.round(Math.max(least, Math.min(MOST * whole(), pixels)));
    document.documentElement.style.setProperty(property, `${bounded}px`);
    element.setAttribute("aria-valuenow", String(bounded));
    return bounded;
  };
  const keep = (pixels) => localStorage.setItem(key, String(set(pixels)));
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    document.body.classList.add(dragging);
  });
  element.addEventListener("pointermove", (event) => {
    if (element.hasPointerCapture(event.pointerId)) keep(whole() - event[pointer]);
  });
  element.addEventListener("lostpointercapture", () => document.body.classList.remove(dragging));
  element.addEventListener("dblclick", () => {
    localStorage.removeItem(key);
    document.documentElement.style.removeProperty(property);
  });
  element.addEventListener("keydown", (event) => {
    const move = keys[event.key];
    if (!move) return;
    event.preventDefault();
    keep(element.parentElement.getBoundingClientRect()[size] + move);
  });
  const kept = Number(localStorage.getItem(key));
  if (kept) set(kept);
}
