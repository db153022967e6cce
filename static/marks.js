// The panel of places to go to: bookmarks with a note, kept in the session, and the keyframes.

import { bookmark } from "./api.js";
import { byId, make, setText } from "./dom.js";
import { clockTime } from "./format.js";

export class Marks {
  #keyframes = "";

  /** `seek(window)` moves the playhead; `problem(sentence)` says what went wrong. */
  constructor(state, { seek, problem }) {
    Object.assign(this, { state, seek, problem });
    this.note = make("input", { type: "text", maxlength: 2000, placeholder: "Note", "aria-label": "Note of the bookmark", autocomplete: "off" });
    this.button = make("button", { title: "Keep this window with the note (B, Enter)" }, "Bookmark");
    const form = make("form", { class: "mark-form" }, this.note, this.button);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#change({ window: state.window, text: this.note.value });
    });
    this.note.addEventListener("keydown", (event) => event.key === "Escape" && this.note.blur());
    this.hint = make("p", { class: "dim hint" });
    this.list = make("ul", { class: "rows" });
    this.frames = make("div", { class: "jumps" });
    byId("panel-marks").replaceChildren(form, this.hint, this.list, this.frames);
    state.watch(["detail", "columns", "session", "live"], () => this.#show());
    state.watch(["window"], () => setText(this.button, `Bookmark ${state.window}`));
  }

  /** The key: the panel is shown and the note can be written. */
  begin() {
    byId("tab-marks").click();
    if (!this.note.disabled) this.note.focus();
  }

  async #change(change) {
    const { session } = this.state;
    this.button.disabled = true;
    try {
      const bookmarks = await bookmark(session, change);
      if (this.state.session !== session) return;
      this.note.value = "";
      this.note.blur();
      this.state.set({ detail: { ...this.state.detail, bookmarks } });
    } catch (error) {
      this.problem(error.message);
    } finally {
      this.#enable();
    }
  }

  #enable() {
    const can = Boolean(this.state.detail) && !this.state.live && this.state.windows > 0;
    this.button.disabled = this.note.disabled = !can;
  }

  #show() {
    const { state } = this;
    this.#enable();
    const marks = state.detail?.bookmarks ?? [];
    setText(byId("tab-marks"), marks.length ? `Marks ${marks.length}` : "Marks");
    setText(this.hint, state.live ? "Bookmarks can be set when tracking has ended." : marks.length ? "" : "No bookmarks yet: they are kept in the session.");
    this.hint.hidden = !this.hint.textContent;
    const go = (window, ...children) => make("button", { class: "row", on: { click: () => this.seek(window) } }, make("span", { class: "number dim" }, clockTime(state.timeOf(window))), ...children);
    this.list.replaceChildren(
      ...marks.map(({ bookmark: number, window, text }) =>
        make("li", { class: "mark" }, go(window, make("span", {}, text || `window ${window}`)), make("button", { class: "plain", title: "Take this bookmark away", "aria-label": `Take away the bookmark at window ${window}`, disabled: state.live, on: { click: () => this.#change({ delete: number }) } }, "×")),
      ),
    );
    const keyframes = state.detail?.keyframes ?? [];
    const key = `${state.session} ${keyframes.length} ${keyframes.at(-1)?.window}`;
    if (key === this.#keyframes || !state.columns) return;
    this.#keyframes = key;
    this.frames.replaceChildren(
      ...(keyframes.length ? [make("h3", { class: "dim" }, `Keyframes (${keyframes.length})`)] : []),
      ...keyframes.map(({ keyframe, window }) => make("button", { title: `Keyframe ${keyframe}, window ${window}`, on: { click: () => this.seek(window) } }, clockTime(state.timeOf(window)))),
    );
  }
}
