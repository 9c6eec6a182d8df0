// Colours of the style sheet, for canvases. They follow the colour scheme of the system.

const NAMES = [
  "page", "card", "line", "ink", "soft", "ok", "warn", "bad", "calm", "accent", "series-1", "series-2", "series-3", "series-4",
  "series-5", "series-6", "series-7",
  "floor", "grid", "room", "machine", "link", "net", "trail", "plan", "ghost", "force",
];
const listeners = [];

/** Colours by their names in the style sheet. */
export const colours = {};

export const FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif';

function read() {
  const style = getComputedStyle(document.documentElement);
  for (const name of NAMES) colours[name] = style.getPropertyValue(`--${name}`).trim();
}

/** Colour of a level: ok, warn or bad; calm for all others. */
export function levelColour(level) {
  return colours[level === "ok" || level === "warn" || level === "bad" ? level : "calm"];
}

/** Register a listener for changes of the colour scheme. */
export function onColours(listener) {
  listeners.push(listener);
}

read();
matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => {
  read();
  for (const listener of listeners) listener();
});
