// Making and finding elements. Text is always set as text, so a session's name can never become markup.

/** The element with this id. */
export const byId = (id) => document.getElementById(id);

/**
 * A new element. `attributes` may hold `class`, `dataset`, `on` (event handlers) and any attribute;
 * `true` sets an empty attribute, `false`, `null` and `undefined` leave it away.
 */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "dataset") Object.assign(element.dataset, value);
    else if (name === "on") for (const [event, handler] of Object.entries(value)) element.addEventListener(event, handler);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Sets the text only when it differs: the browser then has nothing to lay out. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A colour of the theme, as CSS says it now. */
export const themeColour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
