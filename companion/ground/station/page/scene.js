// The 3D scene: room, tether, planned and flown path, and the vehicle.

import { Camera, steer } from "./camera.js";
import { colours, levelColour } from "./colours.js";
import { fitCanvas } from "./dom.js";
import { fixed, quantity } from "./format.js";
import { add, circle, hanging, LEVEL, mix, rotate, sub } from "./geometry.js";
import { lampLevel } from "./verdict.js";
import { drawBall, drawForce, drawGhost, drawMachine, drawShadow } from "./machine.js";
import { Renderer } from "./renderer.js";

export class SceneView {
  /** @param changed called when the scene should be drawn again */
  constructor(canvas, presets, changed) {
    this.canvas = canvas;
    this.camera = new Camera();
    this._presets = [...presets.querySelectorAll("button")];
    for (const button of this._presets) {
      button.addEventListener("click", () => {
        this.camera.use(button.dataset.preset);
        this._press();
        changed();
      });
    }
    steer(this.camera, canvas, () => {
      this._press();
      changed();
    });
  }

  _press() {
    for (const button of this._presets) button.setAttribute("aria-pressed", String(button.dataset.preset === this.camera.preset));
  }

  /** @param partner the other vehicle of a team, or null; @param gone why its data is not live, such as STALE, else empty */
  draw(vehicle, partner = null, gone = "") {
    const fitted = fitCanvas(this.canvas);
    if (fitted === null) return;
    const { context, width, height } = fitted;
    const scene = vehicle?.scene ?? null;
    const stream = vehicle?.stream ?? null;
    if (scene === null) {
      context.fillStyle = colours.soft;
      context.font = "15px system-ui, sans-serif";
      context.textAlign = "center";
      context.fillText("No scene yet: the vehicle has not sent its geometry.", width / 2, height / 2);
      return;
    }
    const room = { min: scene.room_min_world_m, max: scene.room_max_world_m };
    const position = stream?.position_world_m ?? null;
    const attitude = stream?.attitude_wxyz ?? LEVEL;
    this.camera.aim(width, height, room, position, attitude);
    const renderer = new Renderer(context, this.camera);
    drawRoom(renderer, room);
    if (scene.anchor_world_m) drawReach(renderer, scene, stream, position);
    if (scene.path_world_m.length > 1) renderer.line(scene.path_world_m, colours.plan, { width: 2, dash: [7, 6] });
    const parts = [];
    for (const one of partner === null ? [vehicle] : [partner, vehicle]) {
      drawTrail(renderer, one.flown());
      if (one.scene.anchor_world_m) drawAnchor(renderer, one.scene);
      const at = one.stream?.position_world_m;
      if (at) parts.push([renderer.depth(at), () => this._drawVehicle(renderer, one, { chosen: one === vehicle, grey: one === partner && gone !== "" })]);
    }
    const bar = stream?.bar ?? (gone ? null : partner?.stream?.bar);
    if (bar && scene.bar_length_m) parts.push([renderer.depth(bar.position_world_m), () => drawBar(renderer, bar, scene.bar_length_m)]);
    parts.sort((a, b) => b[0] - a[0]).forEach(([, draw]) => draw());
    if (partner === null) return;
    for (const one of [partner, vehicle]) drawName(renderer, one, one === vehicle, one === partner ? gone : "");
  }

  /** Draw a vehicle that has a position, and the figures beside the chosen one. */
  _drawVehicle(renderer, vehicle, { chosen, grey }) {
    const { scene, stream } = vehicle;
    const position = stream.position_world_m;
    const attitude = stream.attitude_wxyz ?? LEVEL;
    const floor = scene.room_min_world_m[2];
    renderer.context.filter = grey ? "grayscale(1) opacity(0.45)" : "none";
    drawShadow(renderer, scene, position, floor);
    if (stream.reference_world_m) drawGhost(renderer, scene, stream.reference_world_m, stream.reference_yaw_rad, stream.reference_arm_rad);
    if (stream.ball) drawBall(renderer, scene, stream.ball);
    const tied = Boolean(scene.anchor_world_m);
    const behind = tied && renderer.depth(scene.anchor_world_m) > renderer.depth(position);
    if (behind) drawTether(renderer, scene, stream, position, attitude);
    const caught = vehicle.eventLines().some((line) => line.id === "catch");
    drawMachine(renderer, scene, position, attitude, { arm: stream.arm_rad ?? null, caught, armed: Boolean(stream.armed) });
    if (tied && !behind) drawTether(renderer, scene, stream, position, attitude);
    const force = stream.control?.force_ext_world_n;
    if (force && stream.arm_rad) drawForce(renderer, scene, position, attitude, stream.arm_rad, force);
    renderer.context.filter = "none";
    if (!chosen) return;
    if (this.camera.pitch < 1.2) renderer.text([position[0], position[1], floor], `${fixed(position[2], 2)} m`, { dx: 26, dy: 8, align: "left", colour: colours.soft });
    drawSlack(renderer, scene, stream, position, attitude);
  }
}

function drawRoom(renderer, { min, max }) {
  const [x0, y0, z0] = min;
  const [x1, y1, z1] = max;
  renderer.area([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]], colours.floor);
  const step = Math.max(x1 - x0, y1 - y0) > 8 ? 1 : 0.5;
  const grid = (value) => (Math.abs(value) < 1e-9 ? { width: 1.6 } : { width: 1 });
  for (let x = Math.ceil(x0 / step) * step; x <= x1 + 1e-9; x += step) renderer.line([[x, y0, z0], [x, y1, z0]], colours.grid, grid(x));
  for (let y = Math.ceil(y0 / step) * step; y <= y1 + 1e-9; y += step) renderer.line([[x0, y, z0], [x1, y, z0]], colours.grid, grid(y));
  for (let x = Math.ceil(x0); x <= x1; x += 1) renderer.text([x, y0, z0], `${x}`, { dy: 10, size: 11 });
  for (let y = Math.ceil(y0); y <= y1; y += 1) renderer.text([x1, y, z0], `${y}`, { dx: 10, size: 11 });
  for (const z of [z0, z1]) {
    renderer.line([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z], [x0, y0, z]], colours.room, { width: z === z0 ? 2 : 1.2 });
  }
  for (const [x, y] of [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) renderer.line([[x, y, z0], [x, y, z1]], colours.room, { width: 1.2 });
}

/** Draw the reach of the tether minus its margin: the sphere's circles on the floor and at the vehicle's height, inside the room. */
function drawReach(renderer, scene, stream, position) {
  const [ax, ay, az] = scene.anchor_world_m;
  const reach = scene.tether_length_m - scene.tether_margin_m;
  const colour = levelColour(lampLevel(stream, "tether"));
  const heights = [[scene.room_min_world_m[2], 0.45]];
  if (position) heights.push([position[2] + scene.attachment_body_m[2], 0.8]);
  for (const [z, alpha] of heights) {
    const square = reach * reach - (z - az) * (z - az);
    if (square <= 0) continue;
    let piece = [];
    for (const point of circle([ax, ay, z], [1, 0, 0], [0, 1, 0], Math.sqrt(square), 96)) {
      const inside = [0, 1].every((axis) => point[axis] >= scene.room_min_world_m[axis] && point[axis] <= scene.room_max_world_m[axis]);
      if (inside) {
        piece.push(point);
      } else {
        if (piece.length > 1) renderer.line(piece, colour, { width: 1.3, dash: [2, 5], alpha });
        piece = [];
      }
    }
    if (piece.length > 1) renderer.line(piece, colour, { width: 1.3, dash: [2, 5], alpha });
  }
}

function drawTrail(renderer, points) {
  if (points.length < 2) return;
  const recent = points.findIndex((point) => point[3] > points.at(-1)[3] - 6);
  if (recent > 1) renderer.line(points.slice(0, recent + 1), colours.trail, { width: 1.5, alpha: 0.5 });
  renderer.line(points.slice(Math.max(recent, 0)), colours.trail, { width: 2.6 });
}

function drawAnchor(renderer, scene) {
  const [x, y, z] = scene.anchor_world_m;
  const s = 0.07;
  renderer.area([[x - s, y - s, z], [x + s, y - s, z], [x + s, y + s, z], [x - s, y + s, z]], colours.soft);
  renderer.ball(scene.anchor_world_m, 0.035, colours.ink, { least: 3 });
  renderer.text(scene.anchor_world_m, "anchor", { dy: 15, size: 12 });
}

/** Draw the bar between its handles, 24 mm thick. */
function drawBar(renderer, { position_world_m: centre, attitude_wxyz: attitude }, length) {
  const half = rotate(attitude, [length / 2, 0, 0]);
  const ends = [add(centre, half), sub(centre, half)];
  renderer.line(ends, colours.ink, { width: Math.max(4, 0.024 * (renderer.camera.project(centre)?.[2] ?? 0)) });
  for (const end of ends) renderer.ball(end, 0.025, colours.link, { least: 4, edge: colours.card });
}

/** Name a vehicle of a team above it; the frame of the chosen one has the colour of its heading. */
function drawName(renderer, { name, stream }, chosen, gone) {
  const at = stream?.position_world_m;
  if (!at) return;
  const text = chosen ? `▸ ${name}` : [name, gone].filter(Boolean).join(": ");
  const edge = gone ? colours.bad : chosen ? colours.accent : colours.line;
  renderer.text(at, text, { colour: chosen ? colours.ink : colours.soft, edge, size: 13, dy: -46 });
}

const attachment = (scene, position, attitude) => add(position, rotate(attitude, scene.attachment_body_m));

function drawTether(renderer, scene, stream, position, attitude) {
  const end = attachment(scene, position, attitude);
  const level = lampLevel(stream, "tether");
  // A taut tether is drawn straight, whatever its nominal length.
  const points = stream.tether?.taut || stream.tether?.snagged ? [scene.anchor_world_m, end] : hanging(scene.anchor_world_m, end, scene.tether_length_m, scene.room_min_world_m[2]);
  renderer.line(points, colours.card, { width: 5.5, alpha: 0.7 });
  renderer.line(points, levelColour(level), { width: level === "bad" ? 4 : 2.8 });
}

function drawSlack(renderer, scene, stream, position, attitude) {
  const { tether } = stream;
  if (!tether) return;
  const level = lampLevel(stream, "tether");
  const word = tether.snagged ? "SNAGGED · " : tether.taut ? "TAUT · " : "";
  const end = attachment(scene, position, attitude);
  const [from, to] = [renderer.camera.project(scene.anchor_world_m), renderer.camera.project(end)];
  // Next to the line, away from the vehicle.
  const aside = from && to && from[0] > to[0] + 20 ? 84 : -84;
  const middle = mix(scene.anchor_world_m, end, 0.3);
  renderer.text(renderer.camera.project(middle) ? middle : end, `${word}slack ${quantity(tether.slack_m, 2, "m")}`, { colour: level === "unknown" ? colours.soft : levelColour(level), edge: levelColour(level), size: 13, dx: aside });
}
