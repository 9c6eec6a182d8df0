// The plots: their series and limits, and a common time cursor.

import { StripChart } from "./chart.js";
import { degrees, norm } from "./format.js";

export const WINDOW_S = 30;
const AHEAD_S = 10; // a replay also shows the time ahead

const JOINTS_SHOWN = 2; // before the scene of a vehicle is known
const angle = (index) => `α${"₁₂₃₄₅₆₇"[index]}`;
const joint = (field, index) => (record) => degrees(record[field]?.[index]);
const jointLimits = (scene) => scene.joint_max_rad.flatMap((high, index) => [
  { value: degrees(high), label: `${angle(index)} limit`, level: "bad" },
  { value: degrees(scene.joint_min_rad[index]), label: `${angle(index)} limit`, level: "bad" },
]);

function armPlot(joints) {
  const series = [];
  for (let index = 0; index < joints; index += 1) {
    const colour = `${index + 1}`;
    series.push({ label: angle(index), colour, value: joint("arm_rad", index) });
    series.push({ label: "ref", colour, dashed: true, value: joint("reference_arm_rad", index) });
  }
  return { title: "Arm, °", digits: 0, span: 20, series, limits: jointLimits };
}

const CONTACT = {
  title: "Force on the surface, N", digits: 1, span: 2, state: (r) => r.contact?.mode,
  series: [
    { label: "measured", colour: "1", value: (r) => r.contact?.force_n },
    { label: "wanted", colour: "2", dashed: true, value: (r) => r.contact?.wanted_n },
  ],
};

/** All plots for an arm of this many joints, from top to bottom. */
const plotsOf = (joints, contact) => [
  ...(contact ? [CONTACT] : []),
  {
    title: "Position error ‖e_p‖, m", digits: 3, floor: 0, span: 0.02,
    series: [{ label: "", colour: "1", value: (r) => r.e_p_m }],
    limits: (scene) => [{ value: scene.tracking_warn_m, label: "warn", level: "warn" }, { value: scene.tracking_abort_m, label: "abort", level: "bad" }],
  },
  {
    title: "Attitude error ‖e_q‖, °", digits: 1, floor: 0, span: 2,
    series: [{ label: "", colour: "1", value: (r) => r.e_q_deg }],
    limits: (scene) => [{ value: degrees(scene.tilt_abort_rad), label: "tilt abort", level: "bad" }],
  },
  ...(joints ? [armPlot(joints)] : []),
  {
    title: "Thrust", digits: 3, span: 0.08,
    series: [
      { label: "sent", colour: "1", value: (r) => r.thrust },
      { label: "hover", colour: "2", dashed: true, value: (r) => r.control?.hover_thrust },
    ],
    limits: () => [{ value: 1, label: "full", level: "bad" }],
  },
  {
    title: "Adaptation", digits: 4, floor: 0, span: 0.002, spanRight: 0.002,
    series: [
      { label: "ρ", colour: "1", value: (r) => r.control?.rho },
      { label: "‖H‖", colour: "4", right: true, value: (r) => norm(r.control?.h_hat) },
    ],
  },
  {
    title: "Tether", digits: 2, floor: 0, span: 0.5, spanRight: 5,
    series: [
      { label: "slack", unit: "m", colour: "3", value: (r) => r.tether?.slack_m },
      { label: "pull", unit: "N", colour: "2", right: true, value: (r) => r.tether?.pull_n },
    ],
    limits: (scene) => !scene.anchor_world_m ? [] : [{ value: scene.tether_margin_m, label: "margin", level: "warn" }, { value: 0, label: "taut", level: "bad" }],
  },
  {
    title: "Times, ms", digits: 1, floor: 0, span: 5,
    series: [
      { label: "late", colour: "1", value: (r) => r.timing.lateness_ms },
      { label: "mocap", colour: "3", value: (r) => r.timing.mocap_age_ms },
      { label: "sent", colour: "4", value: (r) => r.timing.mocap_to_setpoint_ms },
      { label: "tick", colour: "2", value: (r) => r.timing.whole_ms },
    ],
  },
];

/** Time window of a vehicle: {from, to, now}. */
export function windowOf(vehicle) {
  const now = vehicle.stream?.t_s ?? 0;
  if (!vehicle.replayed) return { from: now - WINDOW_S, to: now, now };
  const first = vehicle.records[0]?.t_s ?? 0;
  const last = Math.max(vehicle.records.at(-1)?.t_s ?? 0, first + WINDOW_S);
  const to = Math.min(last, Math.max(first + WINDOW_S, now + AHEAD_S));
  return { from: to - WINDOW_S, to, now };
}

export class Plots {
  constructor(parent, changed) {
    this._cursor = null; // position of the pointer in the window, 0 to 1
    this._parent = parent;
    this._changed = changed;
    this._build(JOINTS_SHOWN, false);
  }

  _build(joints, contact) {
    const changed = this._changed;
    this._joints = joints;
    this._contact = contact;
    this.charts = plotsOf(joints, contact).map((spec) => new StripChart(spec));
    this._parent.replaceChildren(...this.charts.map((chart) => chart.element));
    for (const chart of this.charts) {
      chart.canvas.addEventListener("pointermove", (event) => {
        this._cursor = Math.max(0, Math.min(1, chart.timeAt(event.offsetX, 0, 1)));
        changed();
      });
      for (const name of ["pointerleave", "pointercancel"]) {
        chart.canvas.addEventListener(name, () => {
          this._cursor = null;
          changed();
        });
      }
    }
  }

  draw(vehicle) {
    const joints = vehicle?.scene?.joint_max_rad.length ?? this._joints;
    const contact = vehicle?.scene ? Boolean(vehicle.scene.has_contact) : this._contact;
    if (joints !== this._joints || contact !== this._contact) this._build(joints, contact);
    const span = vehicle ? windowOf(vehicle) : { from: 0, to: WINDOW_S, now: 0 };
    const shown = {
      ...span,
      records: vehicle?.records ?? [],
      scene: vehicle?.scene ?? null,
      events: vehicle?.replayed ? vehicle.events?.lines ?? [] : vehicle?.eventLines() ?? [],
      origin: vehicle?.takeoff_s ?? null,
      cursor: this._cursor === null ? null : span.from + this._cursor * (span.to - span.from),
    };
    const columns = getComputedStyle(this._parent).gridTemplateColumns.split(" ").length;
    this.charts.forEach((chart, index) => chart.draw(shown, { named: index === 0, labelled: columns > 1 || index === this.charts.length - 1 }));
  }
}
