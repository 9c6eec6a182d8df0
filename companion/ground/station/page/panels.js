// Key figures, device health, preflight rows, and internal values of the controller.

import { byId, make, setData, setText } from "./dom.js";
import { fixed, NOTHING, norm, quantity, readable } from "./format.js";
import { lampLevel } from "./verdict.js";

/** The tiles: name, unit, decimals, and a function of (stream, scene) that returns value, note and level. */
const TILES = [
  {
    id: "tether", title: "Tether slack", unit: "m", digits: 2,
    read: (s, scene) => ({
      value: s.tether?.slack_m, level: lampLevel(s, "tether"),
      note: s.tether ? `margin ${quantity(scene?.tether_margin_m, 2, "m")}` : scene && !scene.anchor_world_m ? "no tether" : "not known",
    }),
  },
  {
    id: "error", title: "Error", unit: "m", digits: 3,
    read: (s, scene) => ({ value: s.e_p_m, level: lampLevel(s, "flight"), note: scene ? `warn at ${quantity(scene.tracking_warn_m, 2, "m")}` : "" }),
  },
  {
    id: "height", title: "Height", unit: "m", digits: 2,
    read: (s) => ({ value: s.position_world_m?.[2], level: "calm", note: quantity(norm(s.velocity_world_m_s), 2, "m/s") }),
  },
  {
    id: "battery", title: "Battery", unit: "%", digits: 0,
    read: (s) => ({
      value: typeof s.battery_remaining === "number" ? s.battery_remaining * 100 : null,
      level: lampLevel(s, "battery"), note: quantity(s.battery_v, 1, "V"),
    }),
  },
  {
    id: "latency", title: "Latency", unit: "ms", digits: 1,
    read: (s) => ({ value: s.timing.mocap_to_setpoint_ms, level: lampLevel(s, "loop"), note: "mocap to PX4" }),
  },
];

export class Figures {
  constructor(parent) {
    this._tiles = TILES.map((tile) => {
      const value = make("span", { text: NOTHING, data: { figure: tile.id } });
      const note = make("div", { className: "note", text: "\u00a0" });
      const line = make("div", { className: "value", children: [value, make("small", { text: ` ${tile.unit}` })] });
      const element = make("div", { className: "tile", children: [make("h2", { text: tile.title }), line, note] });
      parent.append(element);
      return { tile, element, value, note };
    });
  }

  draw(vehicle) {
    for (const { tile, element, value, note } of this._tiles) {
      const read = vehicle?.stream ? tile.read(vehicle.stream, vehicle.scene) : { value: null, note: "\u00a0", level: "unknown" };
      setText(value, fixed(read.value, tile.digits));
      setText(note, read.note);
      setData(element, "level", read.level);
    }
  }
}

const LEVEL_WORDS = { ok: "ok", warn: "warning", bad: "bad", off: "off" };

export class DeviceList {
  constructor(list) {
    this._list = list;
    this._rows = [];
  }

  draw(vehicle) {
    const lights = vehicle?.stream?.lights ?? [];
    if (lights.length === 0) return;
    if (lights.length !== this._rows.length) this._build(lights.length);
    lights.forEach((light, index) => {
      const row = this._rows[index];
      setData(row.element, "light", light.light);
      setText(row.name, light.name);
      setText(row.state, LEVEL_WORDS[light.light] ?? light.light);
      setText(row.text, light.text);
    });
  }

  clear() {
    this._rows = [];
    this._list.replaceChildren(make("li", { className: "soft", text: "No data yet." }));
  }

  _build(count) {
    this._rows = Array.from({ length: count }, () => {
      const lamp = make("span", { className: "lamp" });
      lamp.setAttribute("aria-hidden", "true");
      const [name, state, text] = [make("span"), make("span", { className: "unseen" }), make("span", { className: "text" })];
      const label = make("span", { className: "name", children: [name, " ", state] });
      return { element: make("li", { children: [lamp, label, text] }), name, state, text };
    });
    this._list.replaceChildren(...this._rows.map((row) => row.element));
  }
}

const WORST_FIRST = { refuse: 0, warn: 1, ok: 2, skipped: 3 };

export class PreflightList {
  constructor() {
    this._shown = null;
  }

  draw(vehicle) {
    const preflight = vehicle?.preflight ?? null;
    if (preflight === this._shown) return;
    this._shown = preflight;
    const rows = [...(preflight?.rows ?? [])].sort((a, b) => (WORST_FIRST[a.level] ?? 1) - (WORST_FIRST[b.level] ?? 1));
    const count = (level) => rows.filter((row) => row.level === level).length;
    const parts = [["refuse", "refused"], ["warn", count("warn") === 1 ? "warning" : "warnings"], ["ok", "ok"], ["skipped", "skipped"]];
    const counts = parts.filter(([level]) => count(level) > 0).map(([level, word]) => `${count(level)} ${word}`);
    setText(byId("preflight-count"), counts.join(", ") || "not known");
    byId("preflight-list").replaceChildren(...rows.map((row) => make("li", {
      data: { level: row.level },
      children: [make("span", { className: "level", text: row.level }), make("span", { text: `${readable(row.id)}: ${row.text}` })],
    })));
  }
}

const vector = (value, digits, unit) => (Array.isArray(value) ? `${value.map((part) => fixed(part, digits)).join("  ")} ${unit}` : NOTHING);

/** Rows of the control details: name, and a function that returns the text for a vehicle with a stream. */
const DETAILS = [
  ["PX4 mode", ({ stream: s }) => [readable(s.mode ?? "unknown"), s.armed ? "armed" : "disarmed", readable(s.landed)].filter(Boolean).join(", ")],
  ["safety action", ({ stream: s }) => readable(s.action)],
  ["reference constrained by", ({ stream: s }) => (s.limited_by.length > 0 ? s.limited_by.map(readable).join(", ") : "nothing")],
  ["position", ({ stream: s }) => vector(s.position_world_m, 2, "m")],
  ["reference", ({ stream: s }) => vector(s.reference_world_m, 2, "m")],
  ["pose from", ({ stream: s }) => s.pose_from ?? NOTHING],
  ["commanded force", ({ stream: s }) => vector(s.control?.tau, 1, "N")],
  ["external force", ({ stream: s }) => vector(s.control?.force_ext_world_n, 1, "N")],
  ["contact", ({ stream: s }) => (s.contact ? `${readable(s.contact.mode)}, ${fixed(s.contact.force_n, 1)} of ${quantity(s.contact.wanted_n, 1, "N")}` : "none")],
  ["ball", ({ stream: s }) => (s.ball ? (s.ball.meeting_world_m ? `meets the net in ${quantity(s.ball.meets_in_s, 2, "s")}` : "seen") : "none")],
  ["arm torque", ({ stream: s }) => vector(s.control?.arm_torque_nm, 2, "N m")],
  ["ρ", ({ stream: s }) => fixed(s.control?.rho, 5)],
  ["H", ({ stream: s }) => (s.control ? s.control.h_hat.map((part) => part.toExponential(1)).join("  ") : NOTHING)],
  ["hover thrust", ({ stream: s }) => fixed(s.control?.hover_thrust, 3)],
  ["saturated", ({ stream: s }) => (s.control ? (s.control.saturated ? "yes" : "no") : NOTHING)],
  ["payload", ({ stream: s }) => quantity(s.control?.payload_estimate_kg, 2, "kg")],
  ["stopping slack", ({ stream: s }) => quantity(s.tether?.stop_slack_m, 2, "m")],
  ["tether turns", ({ stream: s }) => fixed(s.tether?.turns, 2)],
  ["joint read to write", ({ stream: s }) => quantity(s.timing.joint_read_to_write_ms, 1, "ms")],
  ["bus read", ({ stream: s }) => quantity(s.timing.bus_read_ms, 2, "ms")],
  ["whole tick", ({ stream: s }) => quantity(s.timing.whole_ms, 2, "ms")],
  ["core", ({ stream: s }) => quantity(s.timing.core_ms, 2, "ms")],
  ["ticks missed", ({ stream: s }) => String(s.timing.missed)],
  ["records dropped", ({ stream: s }) => String(s.timing.dropped)],
  ["messages lost", (vehicle) => (vehicle.replayed ? NOTHING : String(vehicle.lost))],
];

export class ControlDetails {
  constructor() {
    this._values = DETAILS.map(() => make("dd", { text: NOTHING }));
    byId("control-list").append(...DETAILS.flatMap(([name], index) => [make("dt", { text: name }), this._values[index]]));
  }

  draw(vehicle) {
    const state = vehicle?.state;
    setText(byId("control-law"), state ? `${state.law}, ${state.preset}` : "");
    if (!byId("control").open) return;
    DETAILS.forEach(([, read], index) => setText(this._values[index], vehicle?.stream ? read(vehicle) : NOTHING));
  }
}
