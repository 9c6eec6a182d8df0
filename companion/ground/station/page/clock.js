// The page's clock: monotonic, and it includes the time that the computer was suspended.

let sleptMs = 0;
let lastMonotonicMs = performance.now();
let lastWallMs = Date.now();

/** Milliseconds since the page was opened. */
export function nowMs() {
  const monotonicMs = performance.now();
  const wallMs = Date.now();
  const missedMs = wallMs - lastWallMs - (monotonicMs - lastMonotonicMs);
  // Setting the wall clock forward looks the same; it causes at most a needless warning.
  if (missedMs > 1000) sleptMs += missedMs;
  lastMonotonicMs = monotonicMs;
  lastWallMs = wallMs;
  return monotonicMs + sleptMs;
}
