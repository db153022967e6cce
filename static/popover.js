// A menu that a button opens: closed by Esc, by the button again, and by a press elsewhere; walked by the arrow keys.

/** Connects a button with its popover; returns `show(open)`. `opened()` is called before it is shown. */
export function popover(button, menu, opened = () => {}) {
  const show = (open) => {
    if (open) opened();
    menu.hidden = !open;
    button.setAttribute("aria-expanded", String(open));
    if (open) menu.querySelector("input, button, select")?.focus();
  };
  const close = () => {
    if (menu.hidden) return;
    const inside = menu.contains(document.activeElement);
    show(false);
    if (inside) button.focus();
  };
  button.addEventListener("click", () => show(menu.hidden));
  document.addEventListener("pointerdown", ({ target }) => {
    if (!menu.contains(target) && !button.contains(target)) show(false);
  });
  menu.addEventListener("keydown", (event) => {
    if (event.key === "Escape") {
      event.stopPropagation();
      return close();
    }
    const move = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!move || event.target.matches("select")) return;
    event.preventDefault();
    event.stopPropagation();
    const stops = [...menu.querySelectorAll("input:not(:disabled), button:not(:disabled), a[href], select")];
    stops[(stops.indexOf(document.activeElement) + move + stops.length) % stops.length]?.focus();
  });
  return show;
}
