// One strip chart: series over time with limits, event marks and a time cursor.

import { colours, FONT, levelColour } from "./colours.js";
import { fitCanvas, make, setText } from "./dom.js";
import { fixed, readable } from "./format.js";
import { after } from "./vehicle.js";

const LEFT = 42;
const RIGHT = 38; // the same in every plot, so that the time axes align
const TOP = 5;
const BOTTOM = 5;
const BOTTOM_LABELLED = 16;
const LABEL_PX = 12;
const GAP_S = 0.5; // records farther apart are not joined by a line

/** Step of 1, 2 or 5 times a power of ten that divides a span into about `count` parts. */
export function niceStep(span, count) {
  const raw = span / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= raw * 0.999);
}

function stroke(context, colour, width, dash, x0, y0, x1, y1) {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.setLineDash(dash);
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}

/** Draw a label on a plate, so that it is readable over lines. */
function write(context, { text, colour, x, y }) {
  context.textAlign = "left";
  context.textBaseline = "top";
  context.fillStyle = colours.card;
  context.fillRect(x - 2, y - 1, context.measureText(text).width + 4, LABEL_PX);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}

export class StripChart {
  /**
   * @param spec {title, digits, floor, span, spanRight, state(record), series: [{label, unit, colour, dashed, right, value(record)}], limits(scene): [{value, label, level}]}
   *   `state`: word beside the title; `floor`: lower end of the axes; `span`, `spanRight`: smallest range of the axes.
   */
  constructor(spec) {
    this.spec = spec;
    this.canvas = make("canvas");
    this.twoAxes = spec.series.some((series) => series.right);
    this._values = spec.series.map(() => make("b"));
    const legend = spec.series.map((series, index) => {
      const data = { colour: series.colour, ...(series.dashed ? { dashed: "" } : {}) };
      return make("span", { className: "series", data, children: [make("i"), `${series.label} `, this._values[index], series.unit ? ` ${series.unit}` : ""] });
    });
    this._state = make("b");
    const header = [make("h2", { text: spec.title }), ...(spec.state ? [this._state] : []), ...legend];
    this.element = make("div", { className: "plot card", children: [make("header", { children: header }), this.canvas] });
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `${spec.title}, last 30 s`);
  }

  /** Time at a horizontal position on the canvas, s. */
  timeAt(x, from, to) {
    const wide = this.canvas.clientWidth - LEFT - RIGHT;
    return from + ((x - LEFT) / wide) * (to - from);
  }

  /**
   * @param shown {records, from, to, now, cursor, scene, events, origin}: time window in s of the flight clock; `origin` is
   *   the clock at take-off, `cursor` the time under the pointer or null
   */
  draw(shown, { named, labelled }) {
    const fitted = fitCanvas(this.canvas);
    if (fitted === null) return;
    const { context, width, height } = fitted;
    const { records, from, to } = shown;
    const part = records.slice(Math.max(0, after(records, from) - 1), after(records, to) + 1);
    const box = { left: LEFT, right: width - RIGHT, top: TOP, bottom: height - (labelled ? BOTTOM_LABELLED : BOTTOM) };
    const x = (t) => box.left + ((t - from) / (to - from)) * (box.right - box.left);
    const axes = [this._axis(part, false, this.spec.span), this._axis(part, true, this.spec.spanRight ?? this.spec.span)];
    context.font = `11px ${FONT}`;
    this._grid(context, box, axes, x, shown, labelled);
    context.save();
    context.beginPath();
    context.rect(box.left, 0, box.right - box.left, height);
    context.clip();
    const labels = [...this._marks(context, box, x, shown, named), ...this._limits(context, box, axes[0], shown.scene)];
    for (const series of this.spec.series) this._series(context, box, series, part, axes[series.right ? 1 : 0], x);
    for (const time of [shown.cursor, shown.now < to - 1e-6 ? shown.now : null]) {
      if (time === null) continue;
      context.setLineDash([]);
      context.strokeStyle = colours.ink;
      context.lineWidth = 1;
      context.strokeRect(x(time), box.top, 0, box.bottom - box.top);
    }
    for (const label of labels) write(context, label);
    context.restore();
    this._legend(records, shown.cursor ?? shown.now);
  }

  _axis(part, right, span) {
    let low = Infinity;
    let high = -Infinity;
    for (const series of this.spec.series) {
      if (Boolean(series.right) !== right) continue;
      for (const record of part) {
        const value = series.value(record);
        if (typeof value !== "number" || !Number.isFinite(value)) continue;
        if (value < low) low = value;
        if (value > high) high = value;
      }
    }
    if (low > high) [low, high] = [0, span];
    if (this.spec.floor !== undefined) low = Math.min(this.spec.floor, low);
    if (high - low < span) {
      const middle = this.spec.floor !== undefined ? null : (low + high) / 2;
      [low, high] = middle === null ? [low, low + span] : [middle - span / 2, middle + span / 2];
    }
    const step = niceStep((high - low) * 1.08, 3);
    low = Math.floor(low / step + 1e-9) * step;
    high = Math.max(high + (high - low) * 0.06, low + step);
    return { low, high, step, digits: Math.max(0, Math.min(4, -Math.floor(Math.log10(step) + 1e-9))) };
  }

  _grid(context, box, axes, x, { from, to, origin }, labelled) {
    context.lineWidth = 1;
    context.setLineDash([]);
    context.textBaseline = "middle";
    axes.forEach((axis, index) => {
      if (index === 1 && !this.twoAxes) return;
      context.textAlign = index === 0 ? "right" : "left";
      for (let value = axis.low; value <= axis.high; value += axis.step) {
        const y = this._y(box, axis, value);
        if (index === 0) {
          context.strokeStyle = colours.grid;
          context.strokeRect(box.left, y, box.right - box.left, 0);
        }
        context.fillStyle = this.twoAxes ? colours[`series-${this.spec.series.find((series) => Boolean(series.right) === (index === 1)).colour}`] : colours.soft;
        context.fillText(fixed(value, axis.digits), index === 0 ? box.left - 5 : box.right + 5, Math.max(6, Math.min(y, box.bottom - 1)));
      }
    });
    context.textAlign = "center";
    context.textBaseline = "bottom";
    context.fillStyle = colours.soft;
    const zero = origin ?? 0;
    for (let t = Math.ceil((from - zero) / 5) * 5; t <= to - zero; t += 5) {
      const at = x(t + zero);
      context.strokeStyle = colours.grid;
      context.strokeRect(at, box.top, 0, box.bottom - box.top);
      if (labelled && at > box.left + 8 && at < box.right - 12) context.fillText(`${t} s`, at, box.bottom + 14);
    }
  }

  _y(box, axis, value) {
    return box.bottom - ((value - axis.low) / (axis.high - axis.low)) * (box.bottom - box.top);
  }

  /** Draw the event lines; return their labels. */
  _marks(context, box, x, { events, from, to }, named) {
    const labels = [];
    const ends = []; // right end of each row of labels
    for (const event of events) {
      if (event.t_s < from || event.t_s > to) continue;
      const colour = event.severity === "critical" ? colours.bad : event.severity === "warning" ? colours.warn : colours.soft;
      const at = x(event.t_s);
      stroke(context, colour, 1.3, [4, 3], at, box.top, at, box.bottom);
      if (!named) continue;
      const wide = context.measureText(event.id).width;
      const left = at + 4 + wide > box.right ? at - 4 - wide : at + 4;
      const row = [0, 1, 2].find((number) => left > (ends[number] ?? -Infinity));
      if (row === undefined) continue;
      ends[row] = left + wide + 6;
      labels.push({ text: event.id, colour, x: left, y: box.top + LABEL_PX * (row + 1) });
    }
    return labels;
  }

  /** Draw the limit lines; return labels for them and for limits outside the axis, without overlap. */
  _limits(context, box, axis, scene) {
    const labels = [];
    const label = (text, colour, y) => {
      if (labels.every((other) => Math.abs(other.y - y) >= LABEL_PX)) labels.push({ text, colour, x: box.left + 4, y });
    };
    const beyond = { above: [], below: [] };
    for (const limit of scene && this.spec.limits ? this.spec.limits(scene) : []) {
      const colour = levelColour(limit.level);
      if (limit.value > axis.high) beyond.above.push({ ...limit, colour });
      else if (limit.value < axis.low) beyond.below.push({ ...limit, colour });
      else {
        const y = this._y(box, axis, limit.value);
        stroke(context, colour, 1.4, [7, 3], box.left, y, box.right, y);
        label(limit.label, colour, y + 2 > box.bottom - LABEL_PX ? y - LABEL_PX - 1 : y + 2);
      }
    }
    const nearest = [beyond.above.sort((a, b) => a.value - b.value)[0], beyond.below.sort((a, b) => b.value - a.value)[0]];
    nearest.forEach((limit, index) => {
      if (!limit) return;
      const text = `${limit.label} ${fixed(limit.value, Math.min(2, this.spec.digits))} ${index === 0 ? "↑" : "↓"}`;
      label(text, limit.colour, index === 0 ? box.top : box.bottom - LABEL_PX);
    });
    return labels;
  }

  _series(context, box, series, part, axis, x) {
    context.strokeStyle = colours[`series-${series.colour}`];
    context.lineWidth = series.dashed ? 1.4 : 1.8;
    context.setLineDash(series.dashed ? [3, 3] : []);
    context.beginPath();
    let lastT = null;
    for (const record of part) {
      const value = series.value(record);
      if (typeof value !== "number" || !Number.isFinite(value)) {
        lastT = null;
        continue;
      }
      const y = this._y(box, axis, value);
      if (lastT === null || record.t_s - lastT > GAP_S) context.moveTo(x(record.t_s), y);
      else context.lineTo(x(record.t_s), y);
      lastT = record.t_s;
    }
    context.stroke();
  }

  _legend(records, t_s) {
    const index = after(records, t_s + 1e-9) - 1;
    const record = index >= 0 ? records[index] : null;
    if (this.spec.state) setText(this._state, readable((record && this.spec.state(record)) ?? "no contact"));
    this.spec.series.forEach((series, k) => setText(this._values[k], fixed(record ? series.value(record) : null, this.spec.digits)));
  }
}
