// Draws the vehicle: frame, rotors, heading, arm, net, caught payload, and the reference pose as a ghost.

import { colours } from "./colours.js";
import { add, armBody, circle, mix, rotate, scale, yawOnly } from "./geometry.js";

const X = [1, 0, 0];
const Y = [0, 1, 0];
const Z = [0, 0, 1];

/** Draw the vehicle at a pose, the farther parts first. */
export function drawMachine(renderer, scene, position, attitude, { arm = null, caught = false, armed = false } = {}) {
  const world = (body) => add(position, rotate(attitude, body));
  const turn = (body) => rotate(attitude, body);
  const radius = scene.radius_m;
  const high = 0.05;
  const parts = [];
  const disk = diskRadius(scene);
  for (const rotor of scene.rotors_body_m ?? []) {
    const hub = world(rotor);
    parts.push([hub, () => drawRotor(renderer, world([0, 0, 0]), hub, turn, disk, rotor[0] > 1e-9, armed)]);
  }
  parts.push([world([0, 0, -0.06]), () => drawBody(renderer, world, scene, radius)]);
  if (arm?.length) parts.push([world(armBody(scene, arm).joints.at(-1)), () => drawArm(renderer, scene, world, turn, arm, caught)]);
  parts.map(([at, draw]) => [renderer.depth(at), draw]).sort((a, b) => b[0] - a[0]).forEach(([, draw]) => draw());
  renderer.arrow(world([0.1 * radius, 0, high]), world([1.25 * radius, 0, high]), colours.accent, 3);
}

/** Draw a flying ball, its path to the net and the net's place there. */
export function drawBall(renderer, scene, { position_world_m: from, meeting_world_m: to, meets_in_s: time }) {
  if (to) {
    const ring = [[X, Y], [X, Z], [Y, Z]].map(([u, v]) => circle(to, u, v, scene.net_radius_m ?? 0.1));
    for (const line of ring) renderer.line(line, colours.force, { width: 1.2, alpha: 0.7 });
    const sag = (k) => 4.903 * time * time * k * (1 - k); // free fall between two places
    const path = Array.from({ length: 13 }, (_, k) => add(mix(from, to, k / 12), [0, 0, sag(k / 12)]));
    renderer.line(path, colours.force, { width: 2, dash: [4, 5] });
  }
  renderer.ball(from, 0.035, colours.force, { least: 4 });
}

// Radius of the rotor disks, which end at the horizontal reach.
function diskRadius(scene) {
  return scene.radius_m - Math.max(0, ...(scene.rotors_body_m ?? []).map(([x, y]) => Math.hypot(x, y)));
}

function drawRotor(renderer, centre, hub, turn, radius, front, armed) {
  renderer.line([centre, hub], colours.machine, { width: 3 });
  const disk = circle(hub, turn(X), turn(Y), radius, 26);
  const colour = front ? colours.accent : colours.machine;
  renderer.area(disk, colour, armed ? 0.28 : 0.12);
  renderer.line(disk, colour, { width: 1.4, alpha: armed ? 1 : 0.6 });
  renderer.ball(hub, 0.018, colours.machine, { least: 2 });
}

function drawBody(renderer, world, scene, radius) {
  const [long, wide] = [0.32 * radius, 0.22 * radius];
  const plate = [[long, wide], [long, -wide], [-long, -wide], [-long, wide]];
  const foot = -scene.ground_clearance_m;
  for (const side of [1, -1]) {
    const skid = [world([0.4 * radius, side * 0.45 * radius, foot]), world([-0.4 * radius, side * 0.45 * radius, foot])];
    renderer.line(skid, colours.machine, { width: 2, alpha: 0.75 });
    for (const x of [0.2, -0.2]) {
      renderer.line([world([x * radius, side * wide, 0]), world([x * radius, side * 0.45 * radius, foot])], colours.machine, { width: 1.5, alpha: 0.6 });
    }
  }
  for (const z of [-0.05, 0.03]) {
    renderer.area(plate.map(([x, y]) => world([x, y, z])), colours.machine, 0.92);
    renderer.line([...plate, plate[0]].map(([x, y]) => world([x, y, z])), colours.card, { width: 1 });
  }
}

function drawArm(renderer, scene, world, turn, angles, caught) {
  const { joints, net, attitude } = armBody(scene, angles);
  const [along, aside, across] = [X, Y, Z].map((axis) => rotate(attitude, axis));
  if (joints.length > 1) renderer.line(joints.map(world), colours.link, { width: 5 });
  const mouth = add(net, scale(along, -(scene.net_radius_m ?? 0)));
  renderer.line([world(joints.at(-1)), world(mouth)], colours.link, { width: 4 });
  for (const joint of joints) renderer.ball(world(joint), 0.02, colours.machine, { least: 3.5, edge: colours.card });
  if (!scene.net_radius_m) return;
  const hoops = [[along, aside], [along, across], [across, aside]];
  for (const [u, v] of hoops) {
    renderer.line(circle(world(net), turn(u), turn(v), scene.net_radius_m, 20), colours.net, { width: 1.3, alpha: 0.9 });
  }
  if (caught) renderer.ball(world(net), 0.05, colours.warn, { least: 4, edge: colours.card });
}

/** Draw the reference pose. */
export function drawGhost(renderer, scene, reference, yaw, arm) {
  const attitude = yawOnly(yaw ?? 0);
  const world = (body) => add(reference, rotate(attitude, body));
  for (const rotor of scene.rotors_body_m ?? []) {
    const hub = world(rotor);
    renderer.line(circle(hub, rotate(attitude, X), rotate(attitude, Y), diskRadius(scene), 22), colours.ghost, { width: 1, dash: [2, 4] });
    renderer.line([reference, hub], colours.ghost, { width: 1, dash: [2, 4] });
  }
  if (!arm?.length) return;
  const { joints, net } = armBody(scene, arm);
  renderer.line([...joints, net].map(world), colours.ghost, { width: 1.5, dash: [2, 4] });
}

/** Draw the vehicle's shadow and its height above the floor. */
export function drawShadow(renderer, scene, position, floor) {
  const below = [position[0], position[1], floor];
  renderer.area(circle(below, X, Y, scene.radius_m * 0.9, 26), colours.machine, 0.13);
  renderer.line([position, below], colours.soft, { width: 1, dash: [3, 4], alpha: 0.8 });
}

/** Draw a force on the net, 0.08 m per newton. */
export function drawForce(renderer, scene, position, attitude, arm, force) {
  const strength = Math.hypot(...force);
  if (strength < 0.4) return;
  const from = add(position, rotate(attitude, armBody(scene, arm).net));
  const to = add(from, scale(force, Math.min(0.08, 1.2 / strength)));
  renderer.arrow(from, to, colours.force, 3);
  renderer.text(to, `${strength.toFixed(1)} N`, { colour: colours.force, dx: 14, dy: 8, align: "left", size: 13 });
}

