// Assessment of a vehicle's state for the top bar: status word, reason, level, age. Pure.

import { age, readable } from "./format.js";

/** Age at which data is stale. The page updates every 100 ms, so the banner appears within 0.5 s of the last message. */
export const STALE_AFTER_S = 0.4;

const RANK = { unknown: 0, ok: 1, warn: 2, bad: 3 };
const ACTIONS = {
  hold: ["HOLDING", "warn", "stops on the planned path and holds"],
  retract: ["RETURNING", "warn", "folds the arm, returns along the tether, then lands"],
  land: ["LANDING", "warn", "the companion lands"],
  autopilot_land: ["LANDING", "bad", "PX4 lands by itself"],
  terminate: ["TERMINATED", "bad", "rotors are stopped"],
};
const KINDS = { ground: "GROUND", takeoff: "TAKE-OFF", flight: "FLYING", landing: "LANDING", done: "LANDED" };

/** Level of a health lamp: that of the gravest rule of the vehicle's that is active, or of what it measures. */
export function lampLevel(stream, name) {
  const level = stream?.lights?.find((light) => light.name === name)?.light;
  return level === undefined || level === "off" ? "unknown" : level;
}

/** The worse of two levels. */
export function worse(a, b) {
  return RANK[b] > RANK[a] ? b : a;
}

/** Presence of a vehicle: a live stream outweighs the retained state of an older session, and "ended", which has no proof. */
export function presenceOf(vehicle, ageS) {
  const { state, stream } = vehicle;
  if (state === null) return stream === null ? "unknown" : "flying";
  const fresh = stream !== null && ageS !== null && ageS <= STALE_AFTER_S;
  return fresh && (state.session !== stream.session || state.presence === "ended") ? "flying" : state.presence;
}

/**
 * @param vehicle Vehicle or null
 * @param link {open, broker: {connected, text}, everOpen}
 * @returns {word, why, level, presence, stale, ended, ageS, banner: null | {word, text}}
 */
export function assess(vehicle, link, nowMs) {
  const broken = linkProblem(link);
  if (vehicle === null || (vehicle.state === null && vehicle.stream === null)) {
    const idle = { word: "WAITING", why: "for a vehicle", level: "unknown", presence: "unknown", stale: false, ended: false, ageS: null };
    return { ...idle, stale: broken !== null, banner: broken };
  }
  if (vehicle.replayed) return assessReplay(vehicle);
  const ageS = vehicle.ageS(nowMs);
  const presence = presenceOf(vehicle, ageS);
  const verdict = presence === "flying" && vehicle.stream !== null ? assessStream(vehicle) : assessPresence(vehicle, presence);
  const ended = presence === "ended";
  const tooOld = ageS === null ? (vehicle.silentS(nowMs) ?? 0) > STALE_AFTER_S : ageS > STALE_AFTER_S;
  const stale = broken !== null || presence === "lost" || presence === "silent" || (!ended && tooOld);
  return { ...verdict, presence, ended, ageS, stale, banner: stale ? staleBanner(vehicle, verdict, presence, ageS, broken) : null };
}

function linkProblem(link) {
  if (!link.open) {
    return link.everOpen ? { word: "NO CONNECTION", text: "to the monitor on the ground, trying again" } : null;
  }
  if (link.broker && link.broker.connected === false) return { word: "NO BROKER", text: link.broker.text ?? "" };
  return null;
}

function staleBanner(vehicle, verdict, presence, ageS, broken) {
  const known = presence === "flying" && verdict.level !== "unknown";
  const was = known ? `last known: ${verdict.word} in "${readable(vehicle.stream.phase)}"` : verdict.why;
  const old = ageS === null ? "no data was ever received" : "";
  const joined = (...parts) => parts.filter(Boolean).join(" · ");
  if (broken !== null) return { word: broken.word, text: joined(broken.text, known ? was : "", old) };
  if (presence === "lost" || presence === "silent") return { word: presence.toUpperCase(), text: joined(verdict.why, old) };
  return { word: "STALE", text: joined(ageS === null ? "" : was, old) };
}

function assessPresence(vehicle, presence) {
  const text = vehicle.state?.text;
  if (presence === "lost") return { word: "LOST", why: text || "its connection was lost", level: "bad" };
  if (presence === "silent") return { word: "SILENT", why: text || "the flight process sends nothing; the guardian may be landing the vehicle", level: "bad" };
  if (presence === "ended") return assessEnd(vehicle.state);
  return { word: "WAITING", why: "for its first data", level: "unknown" };
}

function assessEnd(state) {
  const outcome = state?.outcome;
  const level = outcome === "completed" ? "ok" : outcome === "crashed" || outcome === "lost" ? "bad" : outcome ? "warn" : "unknown";
  return { word: "ENDED", why: [readable(outcome ?? "unknown outcome"), state?.text].filter(Boolean).join(": "), level };
}

function assessReplay(vehicle) {
  const { records, stream, state } = vehicle;
  const rest = { presence: "flying", stale: false, ended: false, ageS: null, banner: null };
  if (stream === null) return { ...rest, word: "LOADING", why: "the log", level: "unknown" };
  if (stream === records.at(-1) && state?.outcome) return { ...rest, ...assessEnd(state) };
  return { ...rest, ...assessStream(vehicle) };
}

function assessStream({ stream }) {
  const acting = ACTIONS[stream.action];
  const onGround = stream.kind === "ground" || stream.kind === "done";
  let word = KINDS[stream.kind] ?? readable(stream.kind).toUpperCase();
  let level = stream.action === "warn" ? "warn" : "ok";
  const reasons = [];
  if (acting && !(onGround && stream.action === "hold")) {
    word = stream.kind === "done" && stream.action !== "terminate" ? word : acting[0];
    level = acting[1];
    reasons.push(acting[2]);
  }
  if (stream.waits_for_start) reasons.push("ready: waits for START");
  if (onGround && stream.armed) reasons.push("rotors are armed");
  const found = [];
  for (const light of stream.lights ?? []) {
    if (light.light === "warn" || light.light === "bad") found.push({ level: light.light, text: `${light.name}: ${light.text}` });
  }
  for (const item of found) level = worse(level, item.level);
  found.sort((a, b) => RANK[b.level] - RANK[a.level]);
  return { word, level, why: [...found.map((item) => item.text), ...reasons].slice(0, 3).join(" · ") || "all is well" };
}
