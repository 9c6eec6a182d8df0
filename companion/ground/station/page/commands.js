// The command buttons: what may be pressed, and what came of it.

import { byId, make, setData, setHidden, setText } from "./dom.js";

const DOUBLE_MS = 300;
const PRESS_MS = 800;
const NO_ANSWER_MS = 2500; // the monitor itself gives up after 1.5 s and says so
const FRESH_MS = 8000; // so long a button shows what came of it
const LIVE_S = 1; // as the monitor has it
const SAFE = new Set(["hold", "land", "abort"]);
const KEYS = { H: "hold", L: "land", A: "abort" };
const HELP = "use Ctrl-C in the flight's terminal, or the pilot's switch";

/**
 * Why a command cannot be given now; null: it can. Commands that make it safer do not depend on how fresh the data is.
 *
 * @param name of the command
 * @param about {canCommand, whyNot, vehicle, verdict}
 */
export function refusal(name, { canCommand, whyNot, vehicle, verdict }) {
  if (!canCommand) return whyNot || "view only";
  if (vehicle === null) return "no vehicle";
  // The vehicle proves its stream and not its state: while the stream comes in, no state keeps anybody from making it safer.
  if (SAFE.has(name) && verdict.ageS !== null && verdict.ageS <= LIVE_S && vehicle.stream?.proofs?.length > 0) return null;
  if (verdict.ended) return "the flight is over";
  if (vehicle.state && !vehicle.state.commands && vehicle.state.presence !== "lost") return vehicle.state.text || "this vehicle hears no commands";
  if (SAFE.has(name)) return null;
  if (verdict.stale) return "not while the data is old";
  const { stream } = vehicle;
  if (name === "start") return stream?.waits_for_start ? null : "only when it waits for it";
  return stream?.action === "hold" ? null : "only while it holds";
}

export class Commands {
  /** @param send sends a message to the monitor; false: it did not leave */
  constructor(send, now) {
    this._send = send;
    this._now = now;
    this._about = { canCommand: false, whyNot: "not connected yet", vehicle: null, verdict: { ended: false, stale: true } };
    this._told = new Map(); // "vehicle command" -> {state, text, atMs, nonces, sent}
    this._pressedMs = new Map();
    this._buttons = new Map();
    for (const button of byId("commands").querySelectorAll("[data-command]")) this._wire(button);
    addEventListener("keydown", (event) => this._key(event));
  }

  _wire(button) {
    const name = button.dataset.command;
    const hint = make("small", { className: "hint" });
    button.replaceChildren(make("span", { className: "label", text: button.textContent }), hint);
    this._buttons.set(name, { button, hint, output: byId("answers").querySelector(`[data-for="${name}"]`) });
    if (button.dataset.press === "long") new LongPress(button, this._now, () => this._meant(), () => this.press(name));
    else button.addEventListener("click", () => this.press(name));
  }

  /** Whom a long press is for: vehicle, flight and hold that are shown. */
  _meant() {
    const { vehicle } = this._about;
    return JSON.stringify([vehicle?.name, vehicle?.stream?.session, vehicle?.stream?.hold]);
  }

  _key(event) {
    const name = KEYS[event.key];
    if (!name || !event.shiftKey || event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
    if (event.target instanceof HTMLSelectElement) return;
    event.preventDefault();
    this.press(name);
  }

  /** A person wants this command. */
  press(name) {
    const now = this._now();
    if (refusal(name, this._about) !== null || now - (this._pressedMs.get(name) ?? -Infinity) < DOUBLE_MS) return;
    this._pressedMs.set(name, now);
    const vehicle = this._about.vehicle.name;
    const message = { kind: "command", vehicle, command: name };
    if (name === "resume") message.hold = this._about.vehicle.stream?.hold ?? 0;
    const left = this._send(message);
    const told = left ? { state: "wait", text: "sending …" } : { state: "no", text: `NOT SENT, no connection to the monitor: ${HELP}` };
    this._told.set(`${vehicle} ${name}`, { ...told, open: left, atMs: now, nonces: new Set(), sent: 0 });
    this.draw(this._about);
  }

  /** A message of the monitor about commands: sent, refused or ack. */
  hear(message) {
    const name = message.kind === "ack" ? message.data?.command : message.command;
    if (!this._buttons.has(name)) return;
    const key = `${message.vehicle} ${name}`;
    if (message.kind === "sent") this._sent(key, message.nonce);
    else if (message.kind === "refused") this._tell(key, "no", String(message.text ?? "refused"));
    else this._acknowledged(key, message.data);
    this.draw(this._about);
  }

  _sent(key, nonce) {
    const told = this._told.get(key);
    if (!told) return;
    told.nonces.add(nonce);
    told.sent += 1;
    if (told.state === "wait") told.text = "sent, waiting for the vehicle …";
    else if (told.open) told.text = `no answer yet, sent again (${told.sent}): ${HELP}`;
  }

  _acknowledged(key, ack) {
    const mine = this._told.get(key)?.nonces.has(ack.nonce);
    const who = mine ? "" : `${ack.operator}: `;
    this._tell(key, ack.accepted ? "done" : "no", `${ack.accepted ? "✓ " : "✗ "}${who}${ack.text}`, false);
  }

  _tell(key, state, text, open = true) {
    const told = this._told.get(key) ?? { nonces: new Set(), sent: 0 };
    this._told.set(key, { ...told, state, text, open, atMs: this._now() });
  }

  /** Called at least every 100 ms. */
  draw(about) {
    this._about = about;
    const now = this._now();
    const general = about.canCommand ? refusal("hold", about) : about.whyNot || "This page may only watch.";
    setHidden(byId("commands-why"), general === null);
    setText(byId("commands-why"), general ?? "");
    for (const [name, { button, hint, output }] of this._buttons) {
      const why = refusal(name, about);
      if (button.disabled !== (why !== null)) button.disabled = why !== null;
      setText(hint, button.dataset.press !== "long" || general !== null ? "" : why ?? "press and hold");
      const told = about.vehicle === null ? undefined : this._told.get(`${about.vehicle.name} ${name}`);
      if (told?.state === "wait" && now - told.atMs > NO_ANSWER_MS) Object.assign(told, { state: "no", text: `no answer from the monitor: ${HELP}` });
      setText(output, told?.text ?? "");
      setData(output, "state", told?.state ?? "");
      setData(button, "state", told && now - told.atMs < FRESH_MS ? told.state : "");
    }
  }
}

/** A button that must be pressed for 0.8 s, by pointer or key. */
class LongPress {
  /** @param look a text of what is shown: the press ends when it changes; @param act what is done after 0.8 s */
  constructor(button, now, look, act) {
    this._button = button;
    this._now = now;
    this._look = look;
    this._act = act;
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
    this._seen = this._look();
    this._grow();
  }

  _grow() {
    if (this._startMs === null) return;
    const part = Math.min(1, (this._now() - this._startMs) / PRESS_MS);
    if (this._button.disabled || this._look() !== this._seen) this._stop();
    else if (part >= 1) {
      this._stop();
      this._act();
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
