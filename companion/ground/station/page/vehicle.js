// State of one vehicle: newest records, recent stream messages for the plots, the flown path.

const HISTORY_S = 40;
const TRAIL_STEP_M = 0.02;
const TRAIL_MAX = 6000;
const DRIFT = 1e-4; // largest relative drift between two clocks

/** Index of the first record later than t_s, in records that are sorted by t_s. */
export function after(records, t_s) {
  let low = 0;
  let high = records.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (records[middle].t_s > t_s) high = middle;
    else low = middle + 1;
  }
  return low;
}

export class Vehicle {
  constructor(name) {
    this.name = name;
    this.replayed = false;
    this.state = null;
    this.scene = null;
    this.preflight = null;
    this.events = null;
    this.forget();
  }

  /** Discard all stream data, for a new session. */
  forget() {
    this.stream = null;
    this.records = [];
    this.trail = [];
    this.lost = 0;
    this.receivedMs = null;
    this.takeoff_s = null;
    this._offsetMs = null;
    this._lateS = 0;
  }

  /** Add a record of this vehicle; `lateS` is its delay until it reached the monitor. */
  take(kind, data, nowMs, lateS = 0) {
    if (kind === "stream") this._takeStream(data, nowMs, lateS);
    else if (kind === "state" || kind === "scene" || kind === "preflight" || kind === "events") this[kind] = data;
    if (kind === "state" && this.receivedMs === null) this.receivedMs = nowMs;
  }

  _takeStream(data, nowMs, lateS) {
    if (this.stream !== null && this.stream.session !== data.session) this.forget();
    const last = this.stream;
    if (last !== null && data.t_s <= last.t_s) return;
    if (last !== null) this.lost += Math.max(0, data.seq - last.seq - 1);
    const offsetMs = nowMs - data.t_s * 1000;
    const passedMs = this.receivedMs === null ? 0 : nowMs - this.receivedMs;
    this._offsetMs = this._offsetMs === null ? offsetMs : Math.min(offsetMs, this._offsetMs + passedMs * DRIFT);
    this.receivedMs = nowMs;
    this._lateS = lateS;
    this.stream = data;
    this.records.push(data);
    if (this.records.length > 64 && data.t_s - this.records[0].t_s > HISTORY_S * 1.25) {
      this.records = this.records.slice(after(this.records, data.t_s - HISTORY_S));
    }
    this._follow(data);
  }

  /** Add stream messages of a log, in order; may be called repeatedly. */
  load(streams) {
    for (const data of streams) {
      this.records.push(data);
      this._follow(data);
    }
  }

  /** Select the time t_s of a log. */
  seek(t_s) {
    if (this.records.length === 0) return;
    this.stream = this.records[Math.max(0, after(this.records, t_s) - 1)];
  }

  _follow(data) {
    if (this.takeoff_s === null && data.mission_t_s > 0) this.takeoff_s = data.t_s - data.mission_t_s;
    const p = data.position_world_m;
    if (!Array.isArray(p)) return;
    const end = this.trail.at(-1);
    if (end && Math.hypot(p[0] - end[0], p[1] - end[1], p[2] - end[2]) < TRAIL_STEP_M) return;
    this.trail.push([p[0], p[1], p[2], data.t_s]);
    if (this.trail.length > TRAIL_MAX) this.trail = this.trail.filter((_, index) => index % 2 === 0);
  }

  /**
   * Age of the displayed data, s: time since the newest stream message was sent, estimated without a common clock. A message that
   * was delayed is old when it arrives; with simulated time, which has any pace, that is not known. null if there was none.
   */
  ageS(nowMs) {
    if (this.stream === null || this._offsetMs === null) return null;
    const byReceiptS = this._lateS + (nowMs - this.receivedMs) / 1000;
    if (this.state?.simulated) return byReceiptS;
    const byItsClockS = (nowMs - this._offsetMs) / 1000 - this.stream.t_s;
    return Math.max(0, byItsClockS, byReceiptS);
  }

  /** Seconds since the vehicle became known, if no stream message has arrived. */
  silentS(nowMs) {
    return this.receivedMs === null ? null : (nowMs - this.receivedMs) / 1000;
  }

  /** Events of the displayed session up to the displayed time, oldest first, each with its number in the session. */
  eventLines() {
    if (this.events === null || (this.stream !== null && this.events.session !== this.stream.session)) return [];
    const first = this.events.count - this.events.lines.length;
    const lines = this.events.lines.map((line, index) => ({ ...line, number: first + index }));
    return this.replayed && this.stream !== null ? lines.filter((line) => line.t_s <= this.stream.t_s + 1e-9) : lines;
  }

  /** The flown path up to the displayed time. */
  flown() {
    if (!this.replayed || this.stream === null) return this.trail;
    const end = this.trail.findIndex((point) => point[3] > this.stream.t_s);
    return end < 0 ? this.trail : this.trail.slice(0, end);
  }
}
