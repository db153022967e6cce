// The numbers of the shown window: estimate, truth and how far they are apart.

import { byId, make, setText } from "./dom.js";
import { fixed, megaRate, percent, significant, vector } from "./format.js";

const norm = (a, b) => (a && b ? Math.hypot(...a.map((value, i) => value - b[i])) : NaN);

/** Yaw about y, pitch about x, roll about z in degrees of a rotation given as a quaternion (w, x, y, z). */
export function angles(q) {
  if (!q) return null;
  const [w, x, y, z] = q;
  const degrees = 180 / Math.PI;
  return [
    Math.asin(Math.max(-1, Math.min(1, 2 * (w * x - y * z)))) * degrees,
    Math.atan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y)) * degrees,
    Math.atan2(2 * (x * y + w * z), 1 - 2 * (x * x + z * z)) * degrees,
  ];
}

/** Degrees between two rotations. */
export function angleBetween(a, b) {
  if (!a || !b) return NaN;
  const dot = Math.abs(a.reduce((sum, value, i) => sum + value * b[i], 0));
  return (2 * Math.acos(Math.min(1, dot)) * 180) / Math.PI;
}

const ROWS = [
  { name: "position", unit: "d", title: "x, y, z in plane distances, in the world frame", of: (v) => vector(v.position), apart: (v, t) => fixed(norm(v.position, t.position), 3) },
  { name: "rotation", unit: "°", title: "About x, y and z in degrees", of: (v) => vector(angles(v.quaternion_wxyz), 1), apart: (v, t) => fixed(angleBetween(v.quaternion_wxyz, t.quaternion_wxyz), 2) },
  { name: "ω", unit: "rad/s", title: "Angular velocity in the camera frame", of: (v) => vector(v.omega, 2), apart: (v, t) => fixed(norm(v.omega, t.omega), 2) },
  { name: "v", unit: "d/s", title: "Linear velocity in plane distances a second, in the camera frame", of: (v) => vector(v.velocity, 2), apart: (v, t) => fixed(norm(v.velocity, t.velocity), 2) },
];
const FACTS = [
  ["window", "Duration of the window", (v) => `${fixed(v.duration_ms, 1)} ms`],
  ["rate", "Event rate", (v) => megaRate(v.event_rate_hz)],
  ["contrast", "Variance of the image of warped events: without motion and at the estimate", (v) => `${significant(v.contrast_before)} → ${significant(v.contrast_after)}`],
  ["map score", "Agreement with the map: 1 perfect, 0 chance", (v) => fixed(v.score, 2)],
  ["confidence", "Chance that the pose is within 2 % of the plane distance", (v) => percent(v.confidence)],
  ["condition", "Condition number of the pose's normal matrix: large where the texture hides a direction", (v) => significant(v.condition)],
  ["position error", "Distance from the truth in per cent of the plane distance, after alignment", (v) => (Number.isFinite(v.error_percent) ? `${fixed(v.error_percent, 2)} % d` : "–"), true],
  ["rotation error", "Angle to the truth after alignment", (v) => (Number.isFinite(v.error_deg) ? `${fixed(v.error_deg, 2)}°` : "–"), true],
];

export class Numbers {
  constructor(state) {
    this.estimate = make("th", { colspan: 3, scope: "col" }, "estimate");
    const head = make("tr", {}, make("th", {}), this.estimate, make("th", { colspan: 3, scope: "col", title: "Ground truth laid on the estimate; velocities are its differences over the window" }, "truth"), make("th", { scope: "col", title: "How far estimate and truth are apart" }, "±"));
    this.rows = ROWS.map((row) => ({ ...row, cells: Array.from({ length: 7 }, () => make("td", {})) }));
    this.facts = FACTS.map(([name, title, of, onlyTruth = false]) => ({ of, onlyTruth, cell: make("dd", {}), name: make("dt", { title }, name) }));
    this.weak = make("p", { class: "weak" });
    this.table = make(
      "table",
      { class: "pose number" },
      make("thead", {}, head),
      make("tbody", {}, ...this.rows.map(({ name, unit, title, cells }) => make("tr", {}, make("th", { scope: "row", title }, name, make("small", { class: "dim" }, ` ${unit}`)), ...cells))),
    );
    this.empty = make("p", { class: "dim hint" }, "The numbers of a window stand here once its images are shown.");
    this.body = make("div", {}, this.table, make("dl", { class: "facts number" }, ...this.facts.flatMap(({ name, cell }) => [make("div", {}, name, cell)])), this.weak);
    byId("panel-numbers").replaceChildren(this.empty, this.body);
    state.watch(["values"], () => this.show(state.values));
  }

  show(values) {
    this.empty.hidden = Boolean(values);
    this.body.hidden = !values;
    if (!values) return;
    const { truth } = values;
    setText(this.estimate, values.refined ? "estimate, refined" : "estimate");
    this.estimate.title = values.refined ? "The pose after the last refinement, as in the evaluation, the scene and the picture on the map" : "The pose as it was found; no refinement has moved it";
    this.table.classList.toggle("no-truth", !truth);
    for (const { of, apart, cells } of this.rows) {
      const estimate = of(values) ?? ["–", "–", "–"];
      const known = truth ? (of(truth) ?? ["–", "–", "–"]) : ["", "", ""];
      [...estimate, ...known, truth ? apart(values, truth) : ""].forEach((text, i) => setText(cells[i], text));
    }
    for (const { of, cell, onlyTruth } of this.facts) {
      cell.parentElement.hidden = onlyTruth && !truth;
      setText(cell, of(values));
    }
    const words = Array.isArray(values.weak) ? values.weak.join(", ") : values.weak;
    this.weak.replaceChildren(...(words ? [make("b", {}, "Seen least: "), words] : []), ...(values.note ? [make("span", { class: "dim" }, ` ${values.note}`)] : []));
  }
}
