// Housekeeping: rename, tag, keep, resume, delete. What cannot be taken back is asked.

import * as api from "./api.js";
import { byId, make, setText } from "./dom.js";
import { amount, duration } from "./format.js";
import { ask } from "./live.js";
import { bytes } from "./runs.js";
import { field } from "./settings.js";

export class Manage {
  #name = null;

  /** `gone(name)` is called when a session was deleted. */
  constructor(state, { gone }) {
    Object.assign(this, { state, gone });
    this.dialog = byId("manage");
  }

  /** Opens the dialog for a session of the list. */
  open(name) {
    const entry = this.state.sessions?.find((session) => session.name === name);
    if (!entry) return;
    this.#name = name;
    this.problem = make("p", { class: "bad", role: "alert", hidden: true });
    const about = [entry.width ? `${entry.width}×${entry.height}` : "", entry.width ? duration(entry.duration_s) : "", entry.events ? `${amount(entry.events)} events` : "", entry.bytes ? bytes(entry.bytes) : ""].filter(Boolean);
    const text = (value, label, attributes = {}) => make("input", { type: "text", value, autocomplete: "off", spellcheck: "false", "aria-label": label, ...attributes });
    const newName = text(name, "Name", { maxlength: 121 });
    const tags = text(entry.tags.join(", "), "Tags", { placeholder: "separated by commas" });
    const busy = Boolean(entry.run);
    const kept = entry.kept || !entry.windows;
    const form = (input, label, words, body, disabled) => {
      const element = make("form", { class: "manage-form" }, field(label, input), make("button", { disabled }, words));
      input.disabled = disabled;
      element.addEventListener("submit", (event) => {
        event.preventDefault();
        this.#change(body());
      });
      return element;
    };
    const wait = busy ? make("p", { class: "dim" }, "It is being tracked: it can be changed when that has ended.") : null;
    const resume = entry.state === "incomplete" && !busy ? make("div", { class: "manage-row" }, make("p", {}, make("b", {}, "Ended early. "), "Tracking can go on where it was stopped."), make("button", { type: "button", class: "accent", on: { click: () => this.#change({ do: "resume" }) } }, "Resume")) : null;
    this.dialog.replaceChildren(
      make("header", {}, make("h2", { id: "manage-title" }, name), make("button", { type: "button", on: { click: () => this.dialog.close() } }, "Close")),
      make("p", { class: "dim number" }, about.join(" · ")),
      wait ?? "",
      resume ?? "",
      entry.windows || entry.state !== "failed"
        ? kept
          ? form(newName, "Name", "Rename", () => ({ do: "rename", name: newName.value }), busy)
          : form(newName, "Name", "Keep as a session", () => ({ do: "keep", name: newName.value }), busy)
        : "",
      entry.windows ? form(tags, "Tags", "Save tags", () => ({ do: "tag", tags: tags.value.split(",") }), busy) : "",
      this.problem,
      make("div", { class: "manage-row" }, make("p", { class: "dim" }, "The recording is never deleted."), make("button", { type: "button", class: "danger", disabled: busy, on: { click: () => this.#delete(entry) } }, entry.windows ? "Delete…" : "Remove")),
    );
    this.dialog.showModal();
  }

  async #change(body) {
    setText(this.problem, "");
    this.problem.hidden = true;
    try {
      await api.change(this.#name, body);
      this.dialog.close();
    } catch (error) {
      this.problem.textContent = error.message;
      this.problem.hidden = false;
    }
  }

  async #delete(entry) {
    const name = this.#name;
    const size = entry.bytes ? ` (${bytes(entry.bytes)})` : "";
    if (entry.windows && !(await ask(`Delete “${name}”?`, `The session${size} is deleted for good: poses, map, marks and all. The recording stays.`, "Delete", "Keep it"))) return;
    await this.#change({ do: "delete", name });
    if (!this.dialog.open) this.gone(name);
  }
}
