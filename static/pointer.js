// Pointer, wheel and touch on the timeline: seek, loop, pan, zoom.

import { byId } from "./dom.js";

const SNAP_PX = 7;
const WHEEL_PER_DOUBLING = 240;

/**
 * Connects the timeline's surface with `actions`: `seek(window)`, `loop({start, end} or null)`, `rest()` after a drag.
 * `context()` returns `{columns, detail, statusOf}`.
 */
export function listen(timeline, context, actions) {
  const box = byId("timeline");
  const touches = new Map();
  let drag = null;

  const place = (event) => {
    const bounds = box.getBoundingClientRect();
    return { x: event.clientX - bounds.left, y: event.clientY - bounds.top };
  };
  const windowAt = (x) => context().columns.windowAt(timeline.scale().t(x));

  /** A mark under the pointer: the worst window of a failure, a keyframe or a bookmark. */
  function markAt({ x, y }) {
    const { marks } = timeline.layout();
    if (y > marks.top + marks.height) return null;
    const { columns, detail } = context();
    const scale = timeline.scale();
    const times = columns.get("t_s");
    const near = (window) => Math.abs(scale.x(times[window]) - x);
    const groups = [detail.failures.map(({ worst }) => worst), [...detail.bookmarks, ...detail.keyframes].map(({ window }) => window)];
    for (const group of groups) {
      const best = group.reduce((a, b) => (a === null || near(b) < near(a) ? b : a), null);
      if (best !== null && near(best) <= SNAP_PX) return best;
    }
    return null;
  }

  function hover(event) {
    const { columns, statusOf } = context();
    const at = place(event);
    const { left, right } = timeline.layout();
    if (at.x < left || at.x > right || event.pointerType === "touch") return timeline.setHover(null);
    const window = markAt(at) ?? columns.windowAt(timeline.scale().t(at.x));
    timeline.setHover({ x: at.x, window, status: statusOf(window) });
  }

  box.addEventListener("pointerdown", (event) => {
    if (!context().columns?.count || event.button > 1) return;
    const at = place(event);
    const layout = timeline.layout();
    touches.set(event.pointerId, at);
    box.setPointerCapture(event.pointerId);
    box.focus({ preventScroll: true });
    if (touches.size === 2) return void (drag = { kind: "pinch", ...pinch() });
    if (at.y >= layout.overview.top - 5) {
      drag = { kind: "overview", whole: timeline.isWhole };
      overview(at);
    } else if (event.button === 1 || event.altKey) drag = { kind: "pan", x: at.x };
    else if (event.shiftKey) drag = { kind: "loop", from: windowAt(at.x) };
    else {
      drag = { kind: "seek" };
      actions.seek(markAt(at) ?? windowAt(at.x));
    }
    event.preventDefault();
  });

  function overview({ x }) {
    if (drag.whole) return actions.seek(context().columns.windowAt(timeline.scale(undefined, true).t(x)));
    const span = timeline.view.end - timeline.view.start;
    timeline.lookAt(timeline.scale(undefined, true).t(x) - span / 2, span);
  }

  function pinch() {
    const [a, b] = [...touches.values()];
    return { middle: (a.x + b.x) / 2, apart: Math.max(20, Math.abs(a.x - b.x)) };
  }

  box.addEventListener("pointermove", (event) => {
    if (!context().columns?.count) return;
    const at = place(event);
    if (touches.has(event.pointerId)) touches.set(event.pointerId, at);
    if (!drag) return hover(event);
    if (drag.kind === "seek") {
      hover(event);
      actions.seek(windowAt(at.x));
    } else if (drag.kind === "overview") overview(at);
    else if (drag.kind === "pan") {
      const scale = timeline.scale();
      timeline.pan(scale.t(drag.x) - scale.t(at.x));
      drag.x = at.x;
    } else if (drag.kind === "loop") {
      const to = windowAt(at.x);
      actions.loop({ start: Math.min(drag.from, to), end: Math.max(drag.from, to) + 1 });
    } else if (touches.size === 2) {
      const now = pinch();
      const scale = timeline.scale();
      timeline.pan(scale.t(drag.middle) - scale.t(now.middle));
      timeline.zoom(drag.apart / now.apart, timeline.scale().t(now.middle));
      drag = { kind: "pinch", ...now };
    }
  });

  const release = (event) => {
    touches.delete(event.pointerId);
    if (drag?.kind === "loop" && windowAt(place(event).x) === drag.from) actions.loop(null);
    if (drag) actions.rest();
    if (!touches.size) drag = null;
  };
  box.addEventListener("pointerup", release);
  box.addEventListener("pointercancel", release);
  box.addEventListener("pointerleave", () => timeline.setHover(null));
  box.addEventListener("dblclick", () => timeline.fit());
  box.addEventListener(
    "wheel",
    (event) => {
      if (!context().columns?.count) return;
      event.preventDefault();
      const unit = event.deltaMode === 1 ? 30 : event.deltaMode === 2 ? 300 : 1;
      const scale = timeline.scale();
      const sideways = event.shiftKey ? event.deltaX || event.deltaY : event.deltaX;
      if (sideways) timeline.pan(scale.t(sideways * unit) - scale.t(0));
      else timeline.zoom(2 ** ((event.deltaY * unit) / WHEEL_PER_DOUBLING), scale.t(place(event).x));
    },
    { passive: false },
  );
}
