// The states of tracking: colour, letter and order of badness. A state is never told by colour alone.

export const STATES = {
  initializing: { letter: "I", badness: 1, colour: "--initializing", pattern: "dots", meaning: "no map yet" },
  tracking: { letter: "T", badness: 0, colour: "--tracking", pattern: "solid", meaning: "pose known" },
  weak: { letter: "W", badness: 2, colour: "--weak", pattern: "slash", meaning: "pose doubtful" },
  lost: { letter: "L", badness: 4, colour: "--lost", pattern: "cross", meaning: "pose not known" },
  relocalizing: { letter: "R", badness: 3, colour: "--relocalizing", pattern: "bars", meaning: "searching the map" },
};

/** Names of the states, the harmless first. */
export const BY_BADNESS = Object.keys(STATES).sort((a, b) => STATES[a].badness - STATES[b].badness);

/** Sets an element's badge to a state's name and colour. */
export function paintBadge(element, state) {
  element.hidden = !state;
  if (element.dataset.state === (state ?? "")) return;
  element.dataset.state = state ?? "";
  element.textContent = state ?? "";
}
