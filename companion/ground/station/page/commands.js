// The command buttons: which are enabled, and the result of each command.

import { byId, make, setData, setHidden, setText } from "./dom.js";

const DOUBLE_MS = 300;
const PRESS_MS = 800;
const NO_ANSWER_MS = 2500; // the monitor reports a missing answer after 1.5 s
const FRESH_MS = 8000; // a button shows its result for this long
const LIVE_S = 1; // same limit as in the monitor
const BUTTONS = [...byId("commands").querySelectorAll("[data-command]")];
const SAFE = new Set(BUTTONS.filter((button) => button.dataset.press !== "long").map((button) => button.dataset.command));
const KEYS = Object.fromEntries(BUTTONS.map((button) => [button.getAttribute("aria-keyshortcuts")?.replace("Shift+", ""), button.dataset.command]));
const HELP = "use Ctrl-C in the flight's terminal, or the pilot's switch";

/**
 * Reason why a command cannot be given now, or null. Commands that make the flight safer do not need fresh data.
 *
 * @param name of the command
 * @param context {canCommand, whyNot, vehicle, verdict, named}: state of page and vehicle; whether the buttons name the vehicle
 */
export function refusal(name, { canCommand, whyNot, vehicle, verdict }) {
  if (!canCommand) return whyNot || "view only";
  if (vehicle === null) return "no vehicle";
  // The stream is proven, the state is not: while the stream arrives, no state message can block a command that makes the flight safer.
  if (SAFE.has(name) && verdict.ageS !== null && verdict.ageS <= LIVE_S && vehicle.stream?.proofs?.length > 0) return null;
  if (verdict.ended) return "the flight is over";
  if (vehicle.state && !vehicle.state.commands && vehicle.state.presence !== "lost") return vehicle.state.text || "this vehicle accepts no commands";
  if (SAFE.has(name)) return null;
  if (verdict.stale) return "not while the data is stale";
  const { stream } = vehicle;
  if (name === "start") return stream?.waits_for_start ? null : "only while waiting for START";
  return stream?.action === "hold" ? null : "only during a hold";
}

export class Commands {
  /** @param send sends a message to the monitor; returns false if there is no connection */
  constructor(send, now) {
    this._send = send;
    this._now = now;
    this._context = { canCommand: false, whyNot: "not connected yet", vehicle: null, verdict: { ended: false, stale: true } };
    this._results = new Map(); // "vehicle command" -> {state, text, atMs, nonces, sent}
    this._pressedMs = new Map();
    this._buttons = new Map();
    for (const button of BUTTONS) this._wire(button);
    addEventListener("keydown", (event) => this._key(event));
  }

  _wire(button) {
    const name = button.dataset.command;
    const hint = make("small", { className: "hint" });
    button.replaceChildren(make("span", { className: "label", text: button.textContent }), hint);
    const output = make("output", { data: { for: name } });
    byId("answers").append(output);
    this._buttons.set(name, { button, hint, output });
    if (button.dataset.press === "long") new LongPress(button, this._now, () => this._target(), () => this.press(name));
    else button.addEventListener("click", () => this.press(name));
  }

  /** Target of a long press: the vehicle, flight and hold that are displayed. */
  _target() {
    const { vehicle } = this._context;
    return JSON.stringify([vehicle?.name, vehicle?.stream?.session, vehicle?.stream?.hold]);
  }

  _key(event) {
    const name = KEYS[event.key];
    if (!name || !event.shiftKey || event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
    if (event.target instanceof HTMLSelectElement) return;
    event.preventDefault();
    this.press(name);
  }

  /** Give a command. */
  press(name) {
    const now = this._now();
    if (refusal(name, this._context) !== null || now - (this._pressedMs.get(name) ?? -Infinity) < DOUBLE_MS) return;
    this._pressedMs.set(name, now);
    const vehicle = this._context.vehicle.name;
    const message = { kind: "command", vehicle, command: name };
    if (name === "resume") message.hold = this._context.vehicle.stream?.hold ?? 0;
    const left = this._send(message);
    const result = left ? { state: "wait", text: "sending …" } : { state: "no", text: `NOT SENT, no connection to the monitor: ${HELP}` };
    this._results.set(`${vehicle} ${name}`, { ...result, open: left, atMs: now, nonces: new Set(), sent: 0 });
    this.draw(this._context);
  }

  /** A message of the monitor about commands: sent, refused or ack. */
  onMessage(message) {
    const name = message.kind === "ack" ? message.data?.command : message.command;
    if (!this._buttons.has(name)) return;
    const key = `${message.vehicle} ${name}`;
    if (message.kind === "sent") this._sent(key, message.nonce);
    else if (message.kind === "refused") this._setResult(key, "no", String(message.text ?? "refused"));
    else this._acknowledged(key, message.data);
    this.draw(this._context);
  }

  /** The newest result of a vehicle's commands, with the name of the command. */
  newest(vehicle) {
    const results = BUTTONS.map(({ dataset: { command: name } }) => ({ name, ...this._results.get(`${vehicle} ${name}`) }));
    return results.filter((result) => result.text).sort((a, b) => b.atMs - a.atMs)[0];
  }

  _sent(key, nonce) {
    const result = this._results.get(key);
    if (!result) return;
    result.nonces.add(nonce);
    result.sent += 1;
    if (result.state === "wait") result.text = "sent, waiting for the vehicle …";
    else if (result.open) result.text = `no answer yet, sent again (${result.sent}): ${HELP}`;
  }

  _acknowledged(key, ack) {
    const mine = this._results.get(key)?.nonces.has(ack.nonce);
    const who = mine ? "" : `${ack.operator}: `;
    this._setResult(key, ack.accepted ? "done" : "no", `${ack.accepted ? "✓ " : "✗ "}${who}${ack.text}`, false);
  }

  _setResult(key, state, text, open = true) {
    const result = this._results.get(key) ?? { nonces: new Set(), sent: 0 };
    this._results.set(key, { ...result, state, text, open, atMs: this._now() });
  }

  /** Called at least every 100 ms. */
  draw(context) {
    this._context = context;
    const now = this._now();
    const general = context.canCommand ? refusal("hold", context) : context.whyNot || "This page is view only.";
    setHidden(byId("commands-why"), general === null);
    setText(byId("commands-why"), general ?? "");
    for (const [name, { button, hint, output }] of this._buttons) {
      const why = refusal(name, context);
      if (button.disabled !== (why !== null)) button.disabled = why !== null;
      const how = button.dataset.press === "long" ? why ?? "press and hold" : "";
      setText(hint, general !== null ? "" : [context.named ? context.vehicle.name : "", how].filter(Boolean).join(": "));
      const result = context.vehicle === null ? undefined : this._results.get(`${context.vehicle.name} ${name}`);
      if (result?.state === "wait" && now - result.atMs > NO_ANSWER_MS) Object.assign(result, { state: "no", text: `no answer from the monitor: ${HELP}` });
      setText(output, result?.text ?? "");
      setData(output, "state", result?.state ?? "");
      setData(button, "state", result && now - result.atMs < FRESH_MS ? result.state : "");
    }
  }
}

/** A button that must be pressed for 0.8 s, by pointer or key. */
class LongPress {
  /** @param readTarget returns the target as text: the press ends when it changes; @param action called after 0.8 s */
  constructor(button, now, readTarget, action) {
    this._button = button;
    this._now = now;
    this._readTarget = readTarget;
    this._action = action;
    this._startMs = null;
    button.addEventListener("pointerdown", (event) => event.button === 0 && this._start());
    for (const name of ["pointerup", "pointerleave", "pointercancel", "blur"]) button.addEventListener(name, () => this._stop());
    button.addEventListener("keydown", (event) => {
      if (event.key !== " " && event.key !== "Enter") return;
      event.preventDefault();
      if (!event.repeat) this._start();
    });
    button.addEventListener("keyup", () => this._stop());
    button.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  _start() {
    if (this._button.disabled) return;
    this._startMs = this._now();
    this._startTarget = this._readTarget();
    this._grow();
  }

  _grow() {
    if (this._startMs === null) return;
    const part = Math.min(1, (this._now() - this._startMs) / PRESS_MS);
    if (this._button.disabled || this._readTarget() !== this._startTarget) this._stop();
    else if (part >= 1) {
      this._stop();
      this._action();
    } else {
      this._button.style.setProperty("--pressed", String(part));
      requestAnimationFrame(() => this._grow());
    }
  }

  _stop() {
    this._startMs = null;
    this._button.style.setProperty("--pressed", "0");
  }
}
