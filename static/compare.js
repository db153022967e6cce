// Comparing: other sessions of the same recording beside the open one. Their curves lie over its own, their paths in its
// scene, and a table says how they differ; windows are matched by their time.

import * as api from "./api.js";
import { readAddress, writeCompared } from "./address.js";
import { Columns } from "./columns.js";
import { byId, make, setText } from "./dom.js";
import { fixed, percent, whole } from "./format.js";
import { STATES, paintBadge } from "./status.js";

const MOST = 3;
const inkOf = (number) => `--compare-${number + 1}`;

const unit = (digits, after) => (value) => (Number.isFinite(value) ? `${fixed(value, digits)}${after}` : "–");
/** `[name, what it means, of a row of the table]`; `than`: which direction is better, for marking the best. */
const ROWS = [
  ["tracked", "Share of windows with a sure pose", ({ tracked_share }) => tracked_share, percent, "more"],
  ["losses", "How often track was lost", ({ losses }) => losses, (value) => whole(value ?? NaN), "less"],
  ["position error", "RMSE against the truth, per cent of the plane distance", (row) => row.position_percent, unit(2, " % d"), "less"],
  ["rotation error", "RMSE against the truth", (row) => row.rotation_deg, unit(2, "°"), "less"],
  ["apart", "RMSE to the open session's poses of the same times, per cent of the plane distance, aligned", (row) => row.apart_percent, unit(2, " % d")],
  ["turned", "RMSE of the angle to the open session's poses", (row) => row.apart_deg, unit(2, "°")],
  ["poses matched", "Poses of the same times that both know", (row) => row.common, (value) => whole(value ?? NaN)],
  ["real time ×", "Seconds of recording tracked in a second; 1 keeps up", (row) => row.real_time_factor, unit(2, ""), "more"],
  ["windows", "How many", (row) => row.windows, whole],
];

export class Compare {
  #asked = 0;
  #table = null;
  #base = null;
  #wanted = null; // names from the address, until the session that they are for is open

  constructor({ state, timeline, socket }, { seek, problem }) {
    Object.assign(this, { state, timeline, socket, seek, problem });
    this.names = [];
    this.#wanted = readAddress().compare;
    this.choice = make("select", { "aria-label": "Compare with", on: { change: () => this.choice.value && this.add(this.choice.value) } });
    this.now = make("ul", { class: "compare-now" });
    this.body = make("div", {});
    byId("panel-compare").replaceChildren(make("label", { class: "compare-choice" }, make("span", { class: "dim" }, "Compare with"), this.choice), this.now, this.body);
    state.watch(["sessions", "session"], () => this.#choices());
    state.watch(["columns"], () => this.#opened());
    state.watch(["window", "compared"], () => this.#here());
    socket.addEventListener("open", () => this.names.length && this.state.columns && this.#draw());
  }

  /** The key: the panel is shown and a session can be chosen. */
  begin() {
    byId("tab-compare").click();
    this.choice.focus();
  }

  /** Lays a session beside the open one. */
  add(name) {
    if (name === this.state.session) return this.begin();
    if (this.names.length >= MOST && !this.names.includes(name)) return this.problem(`Up to ${MOST} sessions can be compared with the open one: take one away first.`);
    if (!this.names.includes(name)) this.#set([...this.names, name]);
    byId("tab-compare").click();
  }

  /** Sessions that an address asks for: now, or when the session that they are for is open. */
  ask(names, session) {
    if (!names.length) return;
    this.#wanted = names;
    if (session !== this.state.session || !this.state.columns) return;
    this.#base = null;
    this.#opened();
  }

  remove(name) {
    this.#set(this.names.filter((other) => other !== name));
  }

  /** Another session is open: those compared with the one before go, those of the address come. */
  #opened() {
    const { session, columns } = this.state;
    if (!columns || session === this.#base) return;
    this.#base = session;
    const wanted = this.#wanted ?? [];
    this.#wanted = null;
    if (wanted.length || this.names.length) this.#set(wanted.filter((name) => name !== session).slice(0, MOST));
    if (this.names.length) byId("tab-compare").click();
  }

  async #set(names) {
    this.names = names;
    const mine = ++this.#asked;
    writeCompared(names);
    this.#choices();
    const { session } = this.state;
    if (!names.length) {
      this.#table = null;
      this.#show([]);
      return this.#draw();
    }
    this.body.replaceChildren(make("p", { class: "dim hint" }, "Laying the sessions on each other…"));
    try {
      const [table, ...found] = await Promise.all([api.compare(session, names), ...names.map((name) => this.#fetch(name, session))]);
      if (mine !== this.#asked) return;
      this.#table = table;
      const t0 = this.state.detail.t0_us;
      this.#show(found.map((columns, i) => ({ name: names[i], columns, ink: inkOf(i), shift: (table[i + 1].t0_us - t0) * 1e-6 })));
      this.#draw();
    } catch (error) {
      if (mine !== this.#asked) return;
      this.#table = null;
      this.#show([]);
      this.names = [];
      writeCompared([]);
      this.#choices();
      this.body.replaceChildren(make("p", { class: "hint bad-words", role: "alert" }, error.message));
    }
  }

  async #fetch(name, base) {
    const [own, laid] = await Promise.all([api.columns(name, 0), api.columns(name, 0, "beside", base)]);
    const columns = new Columns((this.state.detail?.statuses ?? []).map((status) => STATES[status]?.badness ?? 0));
    columns.append(own);
    columns.put(laid);
    return columns;
  }

  #show(compared) {
    this.timeline.setCompared(compared);
    this.state.set({ compared });
    this.#fill();
  }

  /** The paths in the scene. */
  #draw() {
    this.socket.send({ type: "compare", sessions: this.names, window: this.state.window });
  }

  #choices() {
    const { sessions, session } = this.state;
    const mine = sessions?.find(({ name }) => name === session);
    const others = (sessions ?? []).filter(({ name, windows }) => name !== session && windows && !this.names.includes(name));
    const option = ({ name }) => make("option", { value: name }, name);
    const group = (label, entries) => (entries.length ? make("optgroup", { label }, ...entries.map(option)) : null);
    const same = others.filter(({ recording }) => recording === mine?.recording);
    this.choice.replaceChildren(
      ...[make("option", { value: "" }, others.length ? "choose a session" : "there is no other session"), group("of the same recording", same), group("of other recordings", others.filter((entry) => !same.includes(entry)))].filter(Boolean),
    );
    this.choice.value = "";
    this.choice.disabled = !others.length || this.names.length >= MOST;
    if (!this.names.length && !this.#table) this.body.replaceChildren(make("p", { class: "dim hint" }, "A second session of this recording, tracked with other settings, say, is laid over this one: its curves (dashed), its path in the scene, and how far apart they are."));
  }

  /** Which window each session has at the playhead's time, and its state. */
  #here() {
    const { state } = this;
    const time = state.timeOf(state.window);
    const rows = state.compared.map(({ name, columns, ink, shift }) => {
      const window = columns.windowAt(time - shift);
      const badge = make("span", { class: "badge" });
      paintBadge(badge, state.detail?.statuses?.[columns.get("status")[window]] ?? null);
      const [far, turned] = ["apart_percent", "apart_deg"].map((key) => columns.get(key)?.[window]);
      const apart = Number.isFinite(far) ? `${fixed(far, 2)} % d, ${fixed(turned, 2)}° apart here` : "the open session is lost here";
      return make("li", { dataset: { window } }, make("i", { class: "compare-key", dataset: { ink } }), make("b", {}, name), badge, make("span", { class: "dim number" }, `window ${window} · ${apart}`));
    });
    this.now.replaceChildren(...rows);
  }

  #fill() {
    const table = this.#table;
    if (!table) return this.body.replaceChildren();
    const heads = table.map(({ name }, i) =>
      make("th", { scope: "col", title: name }, i ? make("i", { class: "compare-key", dataset: { ink: inkOf(i - 1) } }) : null, make("span", { class: "compare-name" }, name), i ? make("button", { class: "plain", title: `Take ${name} away`, "aria-label": `Take ${name} away`, on: { click: () => this.remove(name) } }, "×") : null),
    );
    const rows = ROWS.map(([name, title, of, words, better]) => {
      const values = table.map(of);
      const known = values.filter(Number.isFinite);
      if (!known.length) return null;
      const best = better && known.length > 1 && Math.max(...known) > Math.min(...known) ? (better === "more" ? Math.max(...known) : Math.min(...known)) : NaN;
      return make("tr", {}, make("th", { scope: "row", title }, name), ...values.map((value) => make("td", { class: value === best ? "best" : null }, Number.isFinite(value) ? words(value) : "–", value === best ? make("span", { class: "visually-hidden" }, " best") : null)));
    });
    const settings = table.slice(1).flatMap(({ name, settings }) => Object.entries(settings).map(([key, [theirs, mine]]) => make("li", {}, make("b", {}, `${key}: `), `${say(theirs)} in ${name}, ${say(mine)} here`)));
    this.body.replaceChildren(
      make("table", { class: "compare-table number" }, make("thead", {}, make("tr", {}, make("th", {}), ...heads)), make("tbody", {}, ...rows.filter(Boolean))),
      settings.length ? make("ul", { class: "compare-settings dim" }, ...settings) : make("p", { class: "dim hint" }, "They were made with the same settings."),
    );
    setText(byId("tab-compare"), `Compare ${table.length}`);
  }
}

const say = (value) => (value === null || value === undefined ? "automatic" : String(value));
