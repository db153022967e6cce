// What stands in the place of the dashboard when the server does not know this browser, and what is shown
// when there is nothing to show.

import { byId, make } from "./dom.js";
import { readAddress } from "./address.js";

/** Asks for the token; `enter(token)` tries it and throws when it is refused. */
export function showDoor(why, enter) {
  const field = make("input", { id: "door-token", type: "text", autocomplete: "off", spellcheck: "false", placeholder: "http://127.0.0.1:…/#token=…" });
  const refused = make("p", { class: "refused", role: "alert" }, why);
  const form = make(
    "form",
    {},
    make("label", { for: "door-token" }, "Address or token"),
    make("div", { class: "field" }, field, make("button", { class: "accent" }, "Open")),
  );
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    const text = field.value.trim();
    const hash = text.indexOf("#");
    const token = hash >= 0 ? readAddress(text.slice(hash)).token : text;
    if (!token) return void (refused.textContent = "Paste the address that the terminal shows, or its token.");
    try {
      await enter(token);
      closeDoor();
    } catch (error) {
      refused.textContent = error.status === 403 ? "This token is not the one of the running server." : error.message;
      field.select();
    }
  });
  const door = byId("door");
  door.replaceChildren(
    make(
      "div",
      { class: "door-card" },
      make("p", { class: "brand" }, "dvsviz"),
      make("h2", { id: "door-title" }, "This page needs its key"),
      refused,
      make("p", { class: "dim" }, "The server makes a new token each time it starts, so that other programs and other people on this machine cannot look in. Open the address that it printed in the terminal; it is the line that begins with http."),
      form,
    ),
  );
  door.hidden = false;
  document.body.classList.add("shut");
  field.focus();
}

export function closeDoor() {
  byId("door").hidden = true;
  document.body.classList.remove("shut");
}

/** A message in the place of the 3-D scene; `lines` are paragraphs or elements. Null takes it away. */
export function showEmpty(title, ...lines) {
  const empty = byId("scene-empty");
  empty.hidden = title === null;
  document.body.classList.toggle("nothing", title !== null);
  if (title !== null) empty.replaceChildren(make("h2", {}, title), ...lines.map((line) => (typeof line === "string" ? make("p", {}, line) : line)));
}

/** A strip over the page for what passes by itself; null takes it away. */
export function showBanner(text) {
  const banner = byId("banner");
  banner.hidden = !text;
  banner.textContent = text ?? "";
}
