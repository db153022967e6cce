// The tracker's settings as a form. Which there are the server says; this file knows only what they are called.

import { make } from "./dom.js";

const WORDS = {
  motion: { label: "Motion", choices: { planar: "6 degrees of freedom, before a plane", translation: "translation only", rotation: "rotation only" } },
  mode: { label: "Mode", title: "Contrast is slower, and the reference: each window by its own sharpness, then by that of map and window together", choices: { map: "aligned with the map", contrast: "by contrast alone" } },
  objective: { label: "Objective", title: "What is maximised where contrast is: always in mode contrast, for the first window in mode map", choices: { gradient: "gradient magnitude", highpass: "local high-pass (for study)", michelson: "Michelson (for study)" } },
  window: { label: "Window", unit: "events", empty: "automatic", title: "Events a window; empty lets the image motion choose" },
  max_window_ms: { label: "Longest window", unit: "ms", title: "A window also ends after this time" },
  plane_distance: { label: "Plane distance", unit: "m", empty: "not known", title: "Metres from the first camera to the plane, for metric output; empty leaves 1" },
  imu: { label: "Gyroscope", choices: { off: "not used", auto: "where there is one" }, title: "Predicts rotations, and carries them over what says nothing" },
  seed: { label: "Seed", title: "Of every random choice: the same seed, the same result" },
};

let number = 0;

/** A labelled input in a row: label, field, unit. */
export function field(label, input, unit = "", title = "") {
  input.id ||= `field-${++number}`;
  return make("div", { class: "field-row", title: title || null }, make("label", { for: input.id }, label), input, make("span", { class: "dim unit" }, unit));
}

/** A field for a number; empty is null. */
export function numberField(attributes = {}) {
  return make("input", { type: "text", inputmode: "decimal", autocomplete: "off", spellcheck: "false", class: "number", ...attributes });
}

/** The number in a field: null where it is empty, NaN where it is none. Decimal commas are understood. */
export function numberIn(input) {
  const text = input.value.trim().replace(",", ".").replace("−", "-");
  return text === "" ? null : Number(text);
}

/** A form for `fields` of the server; `changed()` is called after every change. */
export class Settings {
  #inputs = new Map();

  constructor(fields, changed = () => {}) {
    this.fields = fields;
    this.rows = fields.map((item) => {
      const words = WORDS[item.name] ?? {};
      const label = words.label ?? item.name.replaceAll("_", " ");
      const input = this.#input(item, words);
      input.dataset.setting = item.name;
      input.addEventListener("input", changed);
      this.#inputs.set(item.name, input);
      return field(label, input, words.unit, words.title);
    });
    this.set(Object.fromEntries(fields.map((item) => [item.name, item.default])));
  }

  #input({ kind, choices, optional }, words) {
    if (kind === "choice") return make("select", {}, ...choices.map((choice) => make("option", { value: choice }, words.choices?.[choice] ?? choice)));
    if (kind === "flag") return make("input", { type: "checkbox" });
    return numberField({ placeholder: optional ? (words.empty ?? "none") : null });
  }

  /** Shows values; names that are not there are left as they are. */
  set(values) {
    for (const { name, kind } of this.fields) {
      if (!(name in values)) continue;
      const input = this.#inputs.get(name);
      if (kind === "flag") input.checked = Boolean(values[name]);
      else input.value = values[name] ?? "";
    }
  }

  /** The values; throws a sentence where one is no number. */
  get() {
    const values = {};
    for (const { name, kind, optional } of this.fields) {
      const input = this.#inputs.get(name);
      if (kind === "flag") values[name] = input.checked;
      else if (kind === "choice" || kind === "text") values[name] = input.value;
      else {
        const value = numberIn(input);
        const wrong = value === null ? !optional : !Number.isFinite(value) || (kind === "whole" && !Number.isInteger(value));
        input.toggleAttribute("aria-invalid", wrong);
        if (wrong) {
          input.focus();
          throw new Error(`${WORDS[name]?.label ?? name}: a ${kind === "whole" ? "whole " : ""}number is needed.`);
        }
        values[name] = value;
      }
    }
    return values;
  }
}
