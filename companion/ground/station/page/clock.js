// The page's own clock: monotonic, but it also counts the time that the computer slept through.

let sleptMs = 0;
let lastMonotonicMs = performance.now();
let lastWallMs = Date.now();

/** Milliseconds since the page was opened. */
export function nowMs() {
  const monotonicMs = performance.now();
  const wallMs = Date.now();
  const missedMs = wallMs - lastWallMs - (monotonicMs - lastMonotonicMs);
  // A wall clock that is set forward looks the same; the worst of it is one warning too many.
  if (missedMs > 1000) sleptMs += missedMs;
  lastMonotonicMs = monotonicMs;
  lastWallMs = wallMs;
  return monotonicMs + sleptMs;
}
