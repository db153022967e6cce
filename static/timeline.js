// The timeline: lanes of a session over its time, a playhead, marks. Two canvases lie on each other: the lanes
// are painted when data, view or size change, the playhead and the pointer's line at every move.

import { byId, themeColour } from "./dom.js";
import { clockTime } from "./format.js";
import { FONT, axisTime, drawCurve, drawLaneLabels, drawStates, niceRange, stateFills, ticks } from "./lanes.js";

const LANES_AT_FIRST = 5; // the place's usual height is for so many

export class Timeline {
  #lanes = byId("timeline-lanes");
  #over = byId("timeline-over");
  #box = byId("timeline");
  #data = { columns: null, detail: null };
  #beside = null; // columns of a branch, drawn over the session's own
  #besideFrom = 0; // seconds at which it began
  #curves = [];
  #lanesWanted = [];
  #compared = [];
  #dirty = { lanes: true, over: true };
  #frame = 0;
  #fills = null;
  #whole = true; // the view shows the whole session and grows with it
  view = { start: 0, end: 1 };
  playhead = 0;
  hover = null;
  loop = null;

  constructor() {
    new ResizeObserver(() => this.redraw()).observe(this.#box);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.restyle());
  }

  /** Shows a session's columns and marks; null empties it. `fresh` looks at the whole session again. */
  show({ columns, detail }, fresh = false) {
    this.#data = { columns, detail };
    if (fresh) this.#whole = true;
    this.#setCurves();
    if (this.#whole) this.view = { start: 0, end: this.end };
    this.redraw();
  }

  /** Time of the session's end in seconds. */
  get end() {
    const { columns, detail } = this.#data;
    if (!columns?.count) return 1;
    const last = columns.get("t_s")[columns.count - 1];
    const step = columns.count > 1 ? last - columns.get("t_s")[columns.count - 2] : 0.01;
    const known = detail?.state === "live" ? last + step : Math.max(last + step, detail?.duration_s ?? 0);
    return known > 0 ? known : 1;
  }

  get isWhole() {
    return this.#whole;
  }

  /** Shows these curves, top to bottom; more of them take more of the page. */
  setLanes(lanes) {
    this.#lanesWanted = lanes;
    const more = Math.max(0, lanes.length - LANES_AT_FIRST);
    document.documentElement.style.setProperty("--lanes-more", String(more));
    this.#setCurves();
    this.redraw();
  }

  /** Draws the curves of other sessions, dashed: `[{columns, ink, shift}]`, `shift` seconds from their time to this one's. */
  setCompared(others) {
    this.#compared = others;
    this.#setCurves();
    this.redraw();
  }

  #setCurves() {
    const { columns } = this.#data;
    if (!columns?.count) return void (this.#curves = []);
    this.#curves = this.#lanesWanted.map((lane) => {
      const series = [columns, ...this.#compared.map((other) => other.columns)].flatMap((of) => [lane.key, lane.also?.key].map((key) => (key && of.has(key) ? of.spread(key) : null))).filter(Boolean);
      const spread = series.length ? [Math.min(...series.map(([low]) => low)), Math.max(...series.map(([, high]) => high))] : [0, 1];
      const range = lane.fixed ?? niceRange(spread.map((value) => value * (lane.gain ?? 1)), lane.floor, lane.least);
      return { ...lane, range, ink: themeColour(lane.ink), also: lane.also && { ...lane, key: lane.also.key, range, ink: themeColour(lane.also.ink) } };
    });
  }

  /** Draws the curves of a branch, from where it began, over those of the session; null takes them away. */
  setBeside(columns, from = 0) {
    this.#beside = columns;
    this.#besideFrom = from;
    this.redraw();
  }

  /** Keeps what is drawn to the time that a branch was tracked anew. */
  #clipBeside(pen, scale, layout) {
    const x = Math.max(layout.left, scale.x(this.#besideFrom));
    pen.beginPath();
    pen.rect(x, 0, Math.max(0, layout.right - x), layout.height);
    pen.clip();
  }

  setPlayhead(window) {
    if (window === this.playhead && this.#frame) return;
    this.playhead = window;
    this.#keepInView();
    this.#dirty.lanes ||= false;
    this.#ask("over");
  }

  setLoop(loop) {
    this.loop = loop;
    this.#ask("over");
  }

  setHover(hover) {
    this.hover = hover;
    this.#ask("over");
  }

  redraw() {
    this.#ask("lanes");
  }

  /** Colours changed. */
  restyle() {
    this.#fills = null;
    this.#setCurves();
    this.redraw();
  }

  /** Makes `factor` times as much time visible, the time at `seconds` staying where it is. */
  zoom(factor, seconds) {
    const { start, end } = this.view;
    const least = Math.min(this.end, 0.05);
    const span = Math.min(this.end, Math.max(least, (end - start) * factor));
    const share = (seconds - start) / (end - start);
    this.lookAt(seconds - share * span, span);
  }

  pan(seconds) {
    this.lookAt(this.view.start + seconds, this.view.end - this.view.start);
  }

  lookAt(start, span) {
    const from = Math.max(0, Math.min(this.end - span, start));
    this.view = { start: from, end: from + span };
    this.#whole = span >= this.end * 0.9999;
    this.redraw();
  }

  /** The whole session. */
  fit() {
    this.lookAt(0, this.end);
  }

  #keepInView() {
    const t = this.#data.columns?.get("t_s")?.[this.playhead];
    if (t === undefined || this.#whole) return;
    const span = this.view.end - this.view.start;
    if (t < this.view.start || t > this.view.end) this.lookAt(t - 0.15 * span, span);
  }

  /** Where things are, in CSS pixels. */
  layout() {
    const width = this.#box.clientWidth;
    const height = this.#box.clientHeight;
    const font = parseFloat(getComputedStyle(document.documentElement).fontSize) * 0.9;
    const narrow = width < 640;
    const left = Math.round(font * (narrow ? 12.5 : 15.2));
    const right = width - Math.round(font * 3.6);
    const unit = Math.round(font * 1.25);
    const overview = { top: height - unit, height: Math.round(unit * 0.5) };
    const axis = { top: overview.top - unit - 1, height: unit };
    const marks = { top: 2, height: unit - 1 };
    const states = { top: marks.top + marks.height + 1, height: Math.round(font * 1.25) };
    const top = states.top + states.height + 3;
    const rows = Math.max(1, this.#curves.length);
    return { width, height, font, left, right, overview, axis, marks, states, top, row: (axis.top - top) / rows };
  }

  /** Maps seconds to x and back, for the lanes or (`whole`) the overview strip. */
  scale(layout = this.layout(), whole = false) {
    const { start, end } = whole ? { start: 0, end: this.end } : this.view;
    const perSecond = (layout.right - layout.left) / (end - start);
    return {
      left: layout.left,
      right: layout.right,
      end: this.end,
      x: (t) => layout.left + (t - start) * perSecond,
      t: (x) => start + (x - layout.left) / perSecond,
    };
  }

  #ask(what) {
    this.#dirty[what] = true;
    if (what === "lanes") this.#dirty.over = true;
    this.#frame ||= requestAnimationFrame(() => {
      this.#frame = 0;
      if (this.#dirty.lanes) this.#paintLanes();
      if (this.#dirty.over) this.#paintOver();
      this.#dirty = { lanes: false, over: false };
    });
  }

  #pen(canvas, { width, height }) {
    const ratio = devicePixelRatio || 1;
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    return pen;
  }

  #paintLanes() {
    const layout = this.layout();
    if (layout.width < 10) return;
    const pen = this.#pen(this.#lanes, layout);
    const { columns, detail } = this.#data;
    if (!columns?.count) return;
    this.#fills ??= stateFills(pen);
    const scale = this.scale(layout);
    const [ink, dim, grid] = ["--fg", "--dim", "--grid"].map(themeColour);
    const { left, right, font, axis, row, top, states, marks } = layout;

    pen.font = `${font - 1.5}px ${FONT}`;
    pen.textBaseline = "middle";
    const { values, step } = ticks(this.view.start, this.view.end, Math.max(2, (right - left) / 110));
    for (const t of values) {
      const x = Math.round(scale.x(t)) + 0.5;
      pen.fillStyle = grid;
      pen.fillRect(x - 0.5, states.top, 1, axis.top - states.top + 3);
      pen.fillStyle = dim;
      pen.textAlign = x - left < 12 ? "left" : "center";
      pen.fillText(axisTime(t, step), x, axis.top + axis.height / 2 + 2);
    }
    pen.textAlign = "left";
    pen.fillText("time", font, axis.top + axis.height / 2 + 2);

    pen.save();
    pen.beginPath();
    pen.rect(left, 0, right - left, layout.height);
    pen.clip();
    pen.fillStyle = themeColour("--band");
    for (const { start, end } of detail?.failures ?? []) {
      const [a, b] = this.#span(columns, start, end).map(scale.x);
      if (b > left && a < right) pen.fillRect(a, states.top, Math.max(1, b - a), axis.top - states.top);
    }
    drawStates(pen, columns, scale, states.top, states.height, this.#fills);
    // A branch's states below, where it has any: half as high, with its colour under them.
    if (this.#beside?.count) {
      pen.save();
      this.#clipBeside(pen, scale, layout);
      pen.fillStyle = themeColour("--tried");
      pen.fillRect(left, states.top + states.height - 2, right - left, 2);
      drawStates(pen, this.#beside, scale, states.top + states.height * 0.55, states.height * 0.45 - 2, this.#fills, false);
      pen.restore();
    }
    this.#curves.forEach((lane, i) => {
      pen.fillStyle = grid;
      pen.fillRect(left, Math.round(top + (i + 1) * row) - 1, right - left, 1);
      if (lane.also) drawCurve(pen, columns, lane.also, scale, top + i * row + 3, row - 7);
      drawCurve(pen, columns, lane, scale, top + i * row + 3, row - 7);
      for (const { columns: other, ink, shift } of this.#compared) {
        const moved = { ...scale, x: (t) => scale.x(t + shift), t: (x) => scale.t(x) - shift };
        pen.setLineDash([5, 2.5]);
        drawCurve(pen, other, { ...lane, ink: themeColour(ink) }, moved, top + i * row + 3, row - 7);
        pen.setLineDash([]);
      }
      if (this.#beside?.count) {
        pen.save();
        this.#clipBeside(pen, scale, layout);
        drawCurve(pen, this.#beside, { ...lane, ink: themeColour("--tried") }, scale, top + i * row + 3, row - 7);
        pen.restore();
      }
    });
    this.#paintMarks(pen, scale, marks);
    pen.restore();

    const strip = this.scale(layout, true);
    drawStates(pen, columns, strip, layout.overview.top, layout.overview.height, this.#fills, false);
  }

  /** Start and end in seconds of the windows start to end (end left out). */
  #span(columns, start, end) {
    const t = columns.get("t_s");
    return [t[start] ?? 0, end < columns.count ? t[end] : this.end];
  }

  #paintMarks(pen, scale, { top, height }) {
    const { columns, detail } = this.#data;
    const t = columns.get("t_s");
    const bottom = top + height - 1;
    const keyframes = detail?.keyframes ?? [];
    const crowded = keyframes.length > (scale.right - scale.left) / 9;
    pen.fillStyle = themeColour("--keyframe");
    for (const { window } of keyframes) {
      const x = scale.x(t[window]);
      if (!(x >= scale.left - 4 && x <= scale.right + 4)) continue;
      if (crowded) pen.fillRect(x - 0.5, bottom - 5, 1, 5);
      else diamond(pen, x, bottom - 3.5, 3.2);
    }
    pen.fillStyle = themeColour("--accent");
    for (const { window } of detail?.bookmarks ?? []) {
      const x = scale.x(t[window]);
      pen.fillRect(x - 0.6, top, 1.2, height);
      pen.fillRect(x, top, 6, 5);
    }
    pen.fillStyle = themeColour("--lost");
    for (const { start, end, worst } of detail?.failures ?? []) {
      const [a, b] = this.#span(columns, start, end).map(scale.x);
      pen.fillRect(a, top, Math.max(1.5, b - a), 1.5);
      const x = scale.x(t[worst]);
      pen.beginPath();
      pen.moveTo(x - 5, top);
      pen.lineTo(x + 5, top);
      pen.lineTo(x, top + 8);
      pen.fill();
    }
  }

  #paintOver() {
    const layout = this.layout();
    if (layout.width < 10) return;
    const pen = this.#pen(this.#over, layout);
    const { columns } = this.#data;
    if (!columns?.count) return;
    const { left, right, axis, overview, marks, states, row, top, font } = layout;
    const scale = this.scale(layout);
    const accent = themeColour("--accent");
    const [ink, dim] = ["--fg", "--dim"].map(themeColour);
    const t = columns.get("t_s");

    const at = this.hover ? this.hover.window : this.playhead;
    const box = { left, right, font, ink, dim };
    drawStateLabel(pen, states, font, ink, dim);
    this.#curves.forEach((lane, i) => {
      let [value, beside] = [lane.key, lane.also?.key].map((key) => (key ? columns.get(key)?.[at] ?? NaN : null));
      const [first] = this.#compared;
      if (lane.compared && first) value = first.columns.get(lane.key)?.[first.columns.windowAt(t[at] - first.shift)] ?? NaN;
      drawLaneLabels(pen, lane, { ...box, top: top + i * row + 2, height: row - 5 }, value, beside);
    });

    if (this.loop) {
      const [a, b] = this.#span(columns, this.loop.start, this.loop.end).map((s) => Math.max(left, Math.min(right, scale.x(s))));
      pen.globalAlpha = 0.16;
      pen.fillStyle = accent;
      pen.fillRect(a, marks.top, b - a, axis.top - marks.top);
      pen.globalAlpha = 1;
      pen.fillRect(a, marks.top, 2, axis.top - marks.top);
      pen.fillRect(b - 2, marks.top, 2, axis.top - marks.top);
    }

    if (this.hover) {
      pen.fillStyle = dim;
      pen.fillRect(Math.round(this.hover.x), states.top, 1, axis.top - states.top);
      const text = `${clockTime(t[at], 3)} · window ${at}${this.hover.status ? ` · ${this.hover.status}` : ""}`;
      pen.font = `${font - 1}px ${FONT}`;
      const wide = pen.measureText(text).width + 14;
      const x = Math.max(left, Math.min(right - wide, this.hover.x - wide / 2));
      pen.fillStyle = themeColour("--raise");
      pen.strokeStyle = themeColour("--line");
      pen.beginPath();
      pen.roundRect(x, axis.top, wide, axis.height + 1, 4);
      pen.fill();
      pen.stroke();
      pen.fillStyle = ink;
      pen.textAlign = "left";
      pen.textBaseline = "middle";
      pen.fillText(text, x + 7, axis.top + axis.height / 2 + 1);
    }

    const x = scale.x(t[this.playhead]);
    if (x >= left - 1 && x <= right + 1) {
      pen.fillStyle = ink;
      pen.fillRect(Math.round(x) - 0.75, marks.top, 1.5, axis.top - marks.top + 3);
      pen.beginPath();
      pen.moveTo(x - 6, 0);
      pen.lineTo(x + 6, 0);
      pen.lineTo(x, 9);
      pen.fill();
    }

    const strip = this.scale(layout, true);
    pen.fillStyle = ink;
    pen.fillRect(strip.x(t[this.playhead]) - 1, overview.top - 2, 2, overview.height + 4);
    if (!this.#whole) {
      const [a, b] = [strip.x(this.view.start), strip.x(this.view.end)];
      pen.strokeStyle = ink;
      pen.lineWidth = 1.5;
      pen.beginPath();
      pen.roundRect(a, overview.top - 2.5, Math.max(6, b - a), overview.height + 5, 3);
      pen.stroke();
    }
  }
}

function drawStateLabel(pen, { top, height }, font, ink) {
  pen.font = `${font}px ${FONT}`;
  pen.textAlign = "left";
  pen.textBaseline = "middle";
  pen.fillStyle = ink;
  pen.fillText("state", font, top + height / 2);
}

function diamond(pen, x, y, r) {
  pen.beginPath();
  pen.moveTo(x, y - r);
  pen.lineTo(x + r, y);
  pen.lineTo(x, y + r);
  pen.lineTo(x - r, y);
  pen.fill();
}
