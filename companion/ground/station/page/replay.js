// Replay of logs: choose, load, scrub, play at a speed.

import { byId, make, setHidden, setText } from "./dom.js";
import { clockTime, fixed } from "./format.js";
import { Vehicle } from "./vehicle.js";

const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];
const STEP_S = 1;
const FINE_S = 0.05;

export class Replay {
  /** @param changed called when another time is displayed; @param notify called with a line for the user, or null */
  constructor(logs, changed, notify) {
    this.vehicle = null;
    this.playing = false;
    this.speed = 1;
    this.t_s = 0;
    this.name = "";
    this._logs = logs;
    this._changed = changed;
    this._notify = notify;
    this._worker = null;
    this._lastMs = null;
    setHidden(byId("replay"), false);
    byId("control").open = true; // a replay has no command buttons, so there is room
    document.body.dataset.replay = "true";
    this._wire();
    if (logs.length > 0) this.open(0);
    else notify("No log to replay.");
  }

  _wire() {
    const pick = byId("replay-log");
    setHidden(byId("replay-pick"), this._logs.length < 2);
    pick.replaceChildren(...this._logs.map((name, index) => {
      const option = make("option", { text: name });
      option.value = String(index);
      return option;
    }));
    pick.addEventListener("change", () => this.open(Number(pick.value)));
    byId("replay-play").addEventListener("click", () => this.play(!this.playing));
    byId("replay-time").addEventListener("input", (event) => this.seek(Number(event.target.value)));
    byId("replay-speed").addEventListener("change", (event) => this.setSpeed(Number(event.target.value)));
    addEventListener("keydown", (event) => this._key(event));
  }

  _key(event) {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target instanceof HTMLSelectElement) return;
    const onButton = event.target instanceof HTMLButtonElement || event.target.tagName === "SUMMARY";
    const step = event.shiftKey ? FINE_S : STEP_S;
    const acts = {
      " ": onButton ? null : () => this.play(!this.playing),
      ArrowLeft: () => this.seek(this.t_s - step),
      ArrowRight: () => this.seek(this.t_s + step),
      ArrowUp: () => this.setSpeed(SPEEDS[Math.min(SPEEDS.length - 1, SPEEDS.indexOf(this.speed) + 1)]),
      ArrowDown: () => this.setSpeed(SPEEDS[Math.max(0, SPEEDS.indexOf(this.speed) - 1)]),
      Home: () => this.seek(this._from()),
      End: () => this.seek(this._to()),
    };
    const act = acts[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }

  /** Load a log by its index, replacing the displayed one. */
  open(index) {
    this.play(false);
    this._worker?.terminate();
    this.vehicle = null;
    this.name = this._logs[index];
    const worker = new Worker("loader.js", { type: "module" });
    this._worker = worker;
    let count = 0;
    this._notify(`Loading ${this.name} …`);
    worker.addEventListener("message", ({ data }) => {
      if (worker !== this._worker) return;
      if (data.kind === "head") {
        this._begin(data.head);
        count = data.count;
      } else if (data.kind === "streams") {
        this._more(data.streams, count);
      } else {
        this._notify(data.kind === "failed" ? `${this.name} cannot be loaded: ${data.text}` : null);
        this._end();
        worker.terminate();
      }
      this._changed();
    });
    worker.addEventListener("error", () => this._notify(`${this.name} cannot be loaded: the loader did not start.`));
    worker.postMessage({ url: `replay/${index}.json` });
    this._changed();
  }

  _begin(head) {
    this.vehicle = new Vehicle(head.state.vehicle);
    this.vehicle.replayed = true;
    for (const [kind, data] of Object.entries(head)) this.vehicle.take(kind, data, 0);
  }

  _more(streams, count) {
    const first = this.vehicle.records.length === 0;
    this.vehicle.load(streams);
    if (first && streams.length > 0) this.seek(streams[0].t_s);
    this._range();
    this._show();
    this._notify(`Loading ${this.name}: ${Math.round((100 * this.vehicle.records.length) / count)} %`);
  }

  _range() {
    const slider = byId("replay-time");
    slider.min = String(this._from());
    slider.max = String(this._to());
    slider.value = String(this.t_s);
  }

  /** Draw the event marks on the slider once the log is loaded. */
  _end() {
    const lines = this.vehicle?.events?.lines ?? [];
    const span = this._to() - this._from() || 1;
    byId("replay-marks").replaceChildren(...lines.map((line) => {
      const mark = make("span", { data: { severity: line.severity, event: line.id } });
      mark.style.left = `${(100 * (line.t_s - this._from())) / span}%`;
      mark.title = line.text;
      return mark;
    }));
  }

  _from() {
    return this.vehicle?.records[0]?.t_s ?? 0;
  }

  _to() {
    return this.vehicle?.records.at(-1)?.t_s ?? 0;
  }

  seek(t_s) {
    if (this.vehicle === null) return;
    this.t_s = Math.max(this._from(), Math.min(this._to(), t_s));
    this.vehicle.seek(this.t_s);
    this._show();
    this._changed();
  }

  setSpeed(speed) {
    this.speed = speed;
    byId("replay-speed").value = String(speed);
  }

  play(on) {
    if (on && this.vehicle === null) return;
    if (on && this.t_s >= this._to() - 1e-6) this.seek(this._from());
    this.playing = on;
    this._lastMs = null;
    setText(byId("replay-play"), on ? "❚❚" : "▶");
    byId("replay-play").setAttribute("aria-label", on ? "Pause" : "Play");
    if (on) requestAnimationFrame((ms) => this._run(ms));
  }

  _run(ms) {
    if (!this.playing) return;
    const passedS = this._lastMs === null ? 0 : Math.min(0.25, (ms - this._lastMs) / 1000);
    this._lastMs = ms;
    this.seek(this.t_s + passedS * this.speed);
    if (this.t_s >= this._to() - 1e-6) this.play(false);
    else requestAnimationFrame((next) => this._run(next));
  }

  _show() {
    const slider = byId("replay-time");
    if (Number(slider.value) !== this.t_s) slider.value = String(this.t_s);
    const text = `${clockTime(this.t_s - this._from())} / ${clockTime(this._to() - this._from())}`;
    setText(byId("replay-now"), text);
    slider.setAttribute("aria-valuetext", `${fixed(this.t_s - this._from(), 1)} seconds`);
  }
}
