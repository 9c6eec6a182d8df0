// Geometry of the vehicle's parts. World: z up, m. Body: x forward, y left, z up. Quaternions (w, x, y, z) turn body vectors into the world.

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, k) => [a[0] * k, a[1] * k, a[2] * k];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const mix = (a, b, k) => add(scale(a, 1 - k), scale(b, k));
export const LEVEL = [1, 0, 0, 0];

/** Rotate a body vector into the world. */
export function rotate(q, v) {
  const [w, x, y, z] = q;
  const tx = 2 * (y * v[2] - z * v[1]);
  const ty = 2 * (z * v[0] - x * v[2]);
  const tz = 2 * (x * v[1] - y * v[0]);
  return [v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx];
}

/** Heading of the body's x axis, rad. */
export function heading(q) {
  const forward = rotate(q, [1, 0, 0]);
  return Math.atan2(forward[1], forward[0]);
}

export function yawOnly(yaw) {
  return [Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)];
}

/** Product of two quaternions. */
function multiply([aw, ax, ay, az], [bw, bx, by, bz]) {
  return [
    aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw,
  ];
}

/** All joints from the shoulder outwards, and the net, in the body; attitude is that of the last link, which is level at angles 0. */
export function armBody(scene, arm) {
  let point = scene.shoulder_body_m;
  let attitude = LEVEL;
  const joints = [];
  arm.forEach((angle, index) => {
    joints.push(point);
    const axis = scale(scene.joint_axes_body[index], Math.sin(angle / 2));
    attitude = multiply(attitude, [Math.cos(angle / 2), ...axis]);
    point = add(point, rotate(attitude, scene.links_body_m[index]));
  });
  return { joints, net: point, attitude };
}

/** Points of a circle about a centre, in the plane of two unit vectors. */
export function circle(centre, u, v, radius, count = 28) {
  const points = [];
  for (let k = 0; k <= count; k += 1) {
    const angle = (2 * Math.PI * k) / count;
    points.push(add(centre, add(scale(u, radius * Math.cos(angle)), scale(v, radius * Math.sin(angle)))));
  }
  return points;
}

/** Zero of f between low and high; f(low) > 0. */
function bisect(f, low, high) {
  for (let k = 0; k < 60; k += 1) {
    const middle = (low + high) / 2;
    if (f(middle) > 0) low = middle;
    else high = middle;
  }
  return (low + high) / 2;
}

/**
 * Points of a slack line of a given length between two points; the part that would hang below the floor lies on it.
 * The line is a catenary; one that is too short is drawn straight.
 */
export function hanging(a, b, length, floor = 0) {
  const level = Math.hypot(b[0] - a[0], b[1] - a[1]);
  const rise = b[2] - a[2];
  if (length <= Math.hypot(level, rise) * 1.0005) return [a, b];
  const unit = level > 1e-9 ? [(b[0] - a[0]) / level, (b[1] - a[1]) / level] : [1, 0];
  const flat = freeLine(level, rise, length);
  const lowest = Math.min(...flat.map((point) => point[1]));
  const drawn = a[2] + lowest < floor - 1e-6 ? floorLine(level, a[2] - floor, b[2] - floor, length, floor - a[2]) : flat;
  return drawn.map(([along, up, aside = 0]) => [a[0] + unit[0] * along - unit[1] * aside, a[1] + unit[1] * along + unit[0] * aside, a[2] + up]);
}

const PIECES = 32;

/** Catenary in its own plane: (along, up) from the first end. */
function freeLine(level, rise, length) {
  if (level < 1e-3 * length) {
    const deep = (length - Math.abs(rise)) / 2;
    return [[0, 0], [level / 2, Math.min(0, rise) - deep], [level, rise]];
  }
  // sinh(u) / u = sqrt(L^2 - v^2) / d with u = d / 2a
  const wanted = Math.sqrt(length * length - rise * rise) / level;
  const u = bisect((value) => wanted - Math.sinh(value) / value, 1e-6, 40);
  const a = level / (2 * u);
  const lowest = level / 2 - a * Math.atanh(rise / length);
  const start = Math.sinh(-lowest / a);
  const base = a * Math.cosh(-lowest / a);
  const points = [];
  for (let k = 0; k <= PIECES; k += 1) {
    const x = lowest + a * Math.asinh(start + (length * k) / PIECES / a);
    points.push([x, a * Math.cosh((x - lowest) / a) - base]);
  }
  return points;
}

/** A slack line with its middle on the floor: two arcs that end horizontally, and the rest between them. */
function floorLine(level, highA, highB, length, floor) {
  const reach = (a, high) => (high > 0 ? a * Math.acosh(1 + high / a) : 0);
  const arc = (a, high) => Math.sqrt(high * high + 2 * a * Math.max(high, 0));
  const total = (a) => arc(a, highA) + arc(a, highB) + level - reach(a, highA) - reach(a, highB);
  const tiny = 1e-6;
  const a = total(tiny) <= length ? tiny : bisect((value) => total(value) - length, tiny, 1e3);
  const points = [];
  const side = (high, place) => {
    const whole = arc(a, high);
    const list = [];
    for (let k = 0; k <= PIECES / 2 && high > 0; k += 1) {
      const s = (whole * k) / (PIECES / 2);
      list.push([place(a * Math.asinh(s / a)), floor + Math.sqrt(a * a + s * s) - a]);
    }
    return list;
  };
  const from = reach(a, highA);
  const to = level - reach(a, highB);
  points.push(...side(highA, (x) => from - x).reverse());
  if (highA <= 0) points.push([0, floor]);
  points.push(...loose(from, to, length - total(a), floor));
  points.push(...side(highB, (x) => to + x));
  if (highB <= 0) points.push([level, floor]);
  return points;
}

/** The loose part on the floor, in bends: (along, up, aside). */
function loose(from, to, spare, floor) {
  const straight = Math.max(to - from, 0.05);
  if (spare < 0.01) return [];
  const swing = Math.sqrt((straight + spare) ** 2 - straight ** 2);
  const waves = Math.max(1, Math.ceil(swing / 1.0));
  const wide = swing / (4 * waves);
  const points = [];
  const count = waves * 12;
  for (let k = 1; k < count; k += 1) {
    const part = k / count;
    points.push([from + (to - from) * part, floor, wide * Math.sin(2 * Math.PI * waves * part)]);
  }
  return points;
}
