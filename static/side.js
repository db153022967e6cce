// The handles between the parts of the page: the images' width and the timeline's height, by pointer or by arrow keys.

import { byId } from "./dom.js";

const STEP = 24;

/** Width of the images. */
export function sideGrip() {
  grip(byId("side-grip"), {
    key: "dvsviz-side",
    property: "--side",
    dragging: "dragging",
    keys: { ArrowLeft: STEP, ArrowRight: -STEP },
    bound: (pixels) => Math.max(300, Math.min(innerWidth * 0.6, pixels)),
    at: (event) => innerWidth - event.clientX,
    now: (element) => element.parentElement.getBoundingClientRect().width,
  });
}

/** Height of the timeline. */
export function bottomGrip() {
  grip(byId("bottom-grip"), {
    key: "dvsviz-bottom",
    property: "--bottom-kept",
    dragging: "dragging-bottom",
    keys: { ArrowUp: STEP, ArrowDown: -STEP },
    bound: (pixels) => Math.max(150, Math.min(innerHeight * 0.6, pixels)),
    at: (event) => innerHeight - event.clientY,
    now: (element) => element.parentElement.getBoundingClientRect().height,
  });
}

function grip(element, { key, property, dragging, keys, bound, at, now }) {
  const set = (pixels) => {
    const size = Math.round(bound(pixels));
    document.documentElement.style.setProperty(property, `${size}px`);
    element.setAttribute("aria-valuenow", String(size));
    return size;
  };
  const keep = (pixels) => localStorage.setItem(key, String(set(pixels)));
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    document.body.classList.add(dragging);
  });
  element.addEventListener("pointermove", (event) => {
    if (element.hasPointerCapture(event.pointerId)) keep(at(event));
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
    keep(now(element) + move);
  });
  const kept = Number(localStorage.getItem(key));
  if (kept) set(kept);
}
