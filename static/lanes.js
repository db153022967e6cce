// Drawing of the timeline's lanes: state blocks, curves, marks and axes, in CSS pixels on a scaled canvas.

import { themeColour } from "./dom.js";
import { fixed } from "./format.js";
import { BY_BADNESS, STATES } from "./status.js";

/** The type on canvases, as in theme.css. */
export const FONT = themeColour("--font");

const STEPS = [1, 2, 5];

/** Round tick positions, about `count` of them. */
export function ticks(low, high, count) {
  const span = high - low;
  if (!(span > 0) || !Number.isFinite(span)) return { values: [], step: 1 };
  const power = 10 ** Math.floor(Math.log10(span / count));
  const step = power * ([...STEPS, 10].find((factor) => span / (power * factor) <= count) ?? 10);
  const values = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i++) values.push(i * step);
  return { values, step };
}

/** A range whose ends are round numbers, at least `least` wide: noise around nothing is not made large. */
export function niceRange([low, high], floor, least) {
  const bottom = floor ?? low;
  const span = Math.max(least, high - bottom);
  const { step } = ticks(bottom, bottom + span, 4);
  return [floor ?? Math.floor(bottom / step) * step, Math.ceil((bottom + span) / step - 1e-9) * step];
}

/** Fill styles of the states by badness: colour plus a pattern that is told apart without colour. */
export function stateFills(context) {
  return BY_BADNESS.map((name) => {
    const { colour, pattern } = STATES[name];
    const tile = new OffscreenCanvas(8, 8);
    const pen = tile.getContext("2d");
    pen.fillStyle = themeColour(colour);
    pen.fillRect(0, 0, 8, 8);
    pen.strokeStyle = pen.fillStyle = "rgba(0, 0, 0, 0.38)";
    pen.lineWidth = 1.6;
    pen.beginPath();
    if (pattern === "slash" || pattern === "cross") for (const x of [-8, 0, 8]) line(pen, x, 8, x + 8, 0);
    if (pattern === "cross") for (const x of [-8, 0, 8]) line(pen, x, 0, x + 8, 8);
    if (pattern === "bars") line(pen, 4, 0, 4, 8);
    pen.stroke();
    if (pattern === "dots") pen.fillRect(2, 2, 2, 2), pen.fillRect(6, 6, 2, 2);
    return context.createPattern(tile, "repeat");
  });
}

function line(pen, x0, y0, x1, y1) {
  pen.moveTo(x0, y0);
  pen.lineTo(x1, y1);
}

/**
 * Paints the worst state of every pixel column as blocks, with the state's letter where there is room.
 * `scale` maps seconds to x: `{x(t), t(x), left, right}`.
 */
export function drawStates(pen, columns, scale, top, height, fills, letters = true) {
  const worst = columns.pyramid("badness");
  if (!worst) return;
  let from = scale.left;
  let now = -1;
  const close = (to) => {
    if (now < 0 || to <= from) return;
    pen.fillStyle = fills[now];
    pen.fillRect(from, top, to - from, height);
    if (letters && to - from > 14 && height >= 11) {
      pen.font = `700 ${Math.min(11, height - 3)}px ${FONT}`;
      pen.textAlign = "left";
      pen.textBaseline = "middle";
      pen.fillStyle = themeColour(STATES[BY_BADNESS[now]].colour);
      pen.fillRect(from + 2, top + 1, 11, height - 2);
      pen.fillStyle = "#000";
      pen.fillText(STATES[BY_BADNESS[now]].letter, from + 4, top + height / 2 + 0.5);
    }
  };
  for (let x = Math.floor(scale.left); x < scale.right; x++) {
    const start = columns.windowAt(scale.t(x));
    const end = Math.max(start + 1, columns.firstAt(scale.t(x + 1)));
    const inside = scale.t(x + 1) > columns.get("t_s")[0] && scale.t(x) <= scale.end;
    const state = inside ? worst.range(start, Math.min(end, columns.count))[1] : -1;
    if (state !== now) {
      close(x);
      from = x;
      now = state;
    }
  }
  close(scale.right);
}

/** Draws one curve: a line while windows are wide, else the least and greatest value of each pixel column. */
export function drawCurve(pen, columns, lane, scale, top, height) {
  const values = columns.get(lane.key);
  const pyramid = columns.pyramid(lane.key);
  if (!values || !pyramid) return;
  const [low, high] = lane.range;
  const gain = lane.gain ?? 1;
  const y = (value) => top + height - (height * (Math.min(high, Math.max(low, value * gain)) - low)) / (high - low || 1);
  const first = Math.max(0, columns.windowAt(scale.t(scale.left)) - 1);
  const end = Math.min(columns.count, columns.firstAt(scale.t(scale.right)) + 1);
  const times = columns.get("t_s");
  pen.beginPath();
  if (end - first < 1.5 * (scale.right - scale.left)) {
    let open = false;
    for (let i = first; i < end; i++) {
      if (!Number.isFinite(values[i])) {
        open = false;
        continue;
      }
      const x = scale.x(times[i]);
      if (open) pen.lineTo(x, y(values[i]));
      else pen.moveTo(x, y(values[i])), pen.lineTo(x + 0.5, y(values[i]));
      open = true;
    }
  } else {
    let last = null;
    for (let x = Math.floor(scale.left); x < scale.right; x++) {
      const from = columns.firstAt(scale.t(x));
      const to = columns.firstAt(scale.t(x + 1));
      if (to <= from) continue;
      const [least, greatest] = pyramid.range(from, Math.min(to, columns.count));
      if (least === Infinity) {
        last = null;
        continue;
      }
      let y0 = y(greatest);
      let y1 = y(least);
      if (last) {
        // Join with the column before, so that a steep curve has no gaps.
        if (y0 > last[1]) y0 = last[1];
        if (y1 < last[0]) y1 = last[0];
      }
      line(pen, x + 0.5, y0 - 0.4, x + 0.5, y1 + 0.4);
      last = [y(greatest), y(least)];
    }
  }
  pen.strokeStyle = lane.ink;
  pen.lineWidth = 1.1;
  pen.lineJoin = "round";
  pen.stroke();
}

/** Writes the lane's name, unit, value and the ends of its axis. */
export function drawLaneLabels(pen, lane, box, value, beside = null) {
  const { left, right, top, height, font, ink, dim } = box;
  const middle = top + height / 2;
  pen.textBaseline = "middle";
  pen.textAlign = "left";
  pen.font = `${font}px ${FONT}`;
  pen.fillStyle = ink;
  pen.fillText(lane.label, font, middle);
  const wide = pen.measureText(`${lane.label} `).width;
  pen.fillStyle = dim;
  pen.font = `${font - 1.5}px ${FONT}`;
  pen.fillText(lane.unit, font + wide, middle);
  if (value !== null) {
    pen.font = `600 ${font}px ${FONT}`;
    pen.textAlign = "right";
    pen.fillStyle = lane.ink;
    pen.fillText(fixed(value * (lane.gain ?? 1), lane.digits), left - font * 0.7, middle);
  }
  if (beside !== null && Number.isFinite(beside)) {
    pen.fillStyle = lane.also.ink;
    pen.font = `${font - 1}px ${FONT}`;
    pen.fillText(fixed(beside * (lane.gain ?? 1), lane.digits), left - font * 4.6, middle);
  }
  pen.font = `${font - 2.5}px ${FONT}`;
  pen.textAlign = "left";
  pen.fillStyle = dim;
  const axis = (number) => String(+number.toPrecision(3)).replace("-", "−");
  // Low lanes have room for one line only.
  if (height < 2.6 * font) return pen.fillText(`${axis(lane.range[0])}–${axis(lane.range[1])}`, right + 5, middle);
  pen.fillText(axis(lane.range[1]), right + 5, top + 5);
  pen.fillText(axis(lane.range[0]), right + 5, top + height - 4);
}

/** Seconds as an axis label: the decimals that the step needs, minutes above 60 s. */
export function axisTime(seconds, step) {
  const digits = step >= 1 ? 0 : Math.min(3, Math.ceil(-Math.log10(step)));
  if (seconds < 60) return `${fixed(seconds, digits)} s`;
  const minutes = Math.floor(seconds / 60 + 1e-9);
  return `${minutes}:${Math.max(0, seconds - 60 * minutes).toFixed(digits).padStart(digits ? 3 + digits : 2, "0")}`;
}
