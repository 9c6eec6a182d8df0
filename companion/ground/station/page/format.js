// Formatting of numbers and texts.

export const NOTHING = "–";
const DEGREES = 180 / Math.PI;

/** A number with fixed decimals; a dash for an unknown value. */
export function fixed(value, digits) {
  if (typeof value !== "number" || !Number.isFinite(value)) return NOTHING;
  const text = value.toFixed(digits);
  return Number(text) === 0 && text.startsWith("-") ? text.slice(1) : text;
}

/** A number with fixed decimals and its unit. */
export function quantity(value, digits, unit) {
  const text = fixed(value, digits);
  return text === NOTHING ? text : `${text} ${unit}`;
}

export function degrees(rad) {
  return typeof rad === "number" ? rad * DEGREES : null;
}

/** Euclidean norm; null for an unknown value. */
export function norm(vector) {
  return Array.isArray(vector) ? Math.hypot(...vector) : null;
}

/** An age in short form: 0.1 s, 12.3 s, 4 min. */
export function age(seconds) {
  if (!Number.isFinite(seconds)) return NOTHING;
  if (seconds < 100) return `${seconds.toFixed(1)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

/** Minutes and seconds with a tenth: 1:07.5. */
export function clockTime(seconds) {
  const tenths = Math.round(Math.abs(seconds) * 10);
  const rest = (tenths % 600) / 10;
  return `${seconds < 0 ? "-" : ""}${Math.floor(tenths / 600)}:${rest < 10 ? "0" : ""}${rest.toFixed(1)}`;
}

/** An identifier as text: autopilot_land -> autopilot land. */
export function readable(identifier) {
  return String(identifier ?? "").replaceAll("_", " ");
}
