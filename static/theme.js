// Dark, light, or as the system says; remembered by the browser.

import { byId } from "./dom.js";

const THEMES = ["auto", "dark", "light"];
const KEY = "dvsviz-theme";

/** Calls `changed()` when colours are others. */
export function themes(changed) {
  const set = (theme) => {
    document.documentElement.dataset.theme = theme;
    byId("theme").title = `Theme: ${theme === "auto" ? "as the system says" : theme} (T)`;
    changed();
  };
  const next = () => {
    const theme = THEMES[(THEMES.indexOf(document.documentElement.dataset.theme) + 1) % THEMES.length];
    localStorage.setItem(KEY, theme);
    set(theme);
  };
  byId("theme").addEventListener("click", next);
  matchMedia("(prefers-color-scheme: light)").addEventListener("change", changed);
  set(THEMES.includes(localStorage.getItem(KEY)) ? localStorage.getItem(KEY) : "auto");
  return next;
}
