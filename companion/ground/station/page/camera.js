// A camera that orbits a point, controlled by mouse, touch and keys.

import { dot, heading, mix, sub } from "./geometry.js";

const FIELD = (38 * Math.PI) / 180;
const NEAR_M = 0.05;
const PITCH_MAX = Math.PI / 2 - 0.001;
const rad = (degrees) => (degrees * Math.PI) / 180;

/** View directions; `fit` shows the whole room, `follow` keeps the vehicle in the centre. */
const PRESETS = {
  room: { yaw: rad(62), pitch: rad(22), fit: true },
  behind: { yaw: 0, pitch: rad(16), follow: true, distance: 2.1 },
  top: { yaw: rad(90), pitch: PITCH_MAX, fit: true },
  side: { yaw: rad(90), pitch: rad(2), fit: true },
};

export class Camera {
  constructor() {
    this.width = 1;
    this.height = 1;
    this.centre = [0, 0];
    this.target = [0, 0, 1];
    this.use("room");
  }

  use(name) {
    const preset = PRESETS[name];
    this.preset = name;
    this.yaw = preset.yaw;
    this.pitch = preset.pitch;
    this.fits = Boolean(preset.fit);
    this.follows = Boolean(preset.follow);
    this.zoom = 1;
    this.distance = preset.distance ?? 6;
  }

  /** Set the camera for one frame: room as {min, max}, pose of the vehicle or null. */
  aim(width, height, room, position, attitude) {
    this.width = width;
    this.height = height;
    if (this.follows && position) {
      this.target = [position[0], position[1], position[2] - 0.1];
      if (attitude && this.preset === "behind") this.yaw = heading(attitude);
    } else if (this.fits && room) {
      this.target = room.min.map((low, axis) => (low + room.max[axis]) / 2);
    }
    this.centre = [width / 2, height / 2];
    if (this.fits && room) {
      this._fit(room);
      if (position) this._approach(position);
    }
    this._axes();
  }

  _axes() {
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    this.forward = [cp * cy, cp * sy, -sp];
    this.right = [sy, -cy, 0];
    this.up = [sp * cy, sp * sy, cp];
    this.eye = sub(this.target, this.forward.map((value) => value * this.distance));
    this.focal = Math.min(this.height, this.width * 0.8) / (2 * Math.tan(FIELD / 2));
  }

  /** Move as close as possible with all corners of the room visible, and centre them. */
  _fit(room) {
    const corners = [];
    for (let k = 0; k < 8; k += 1) corners.push([0, 1, 2].map((axis) => ((k >> axis) & 1 ? room.max : room.min)[axis]));
    let low = 1;
    let high = 60;
    for (let k = 0; k < 22; k += 1) {
      this.distance = (low + high) / 2;
      const box = this._box(corners);
      if (box !== null && box.wide < this.width - 56 && box.high < this.height - 60) high = this.distance;
      else low = this.distance;
    }
    this.distance = high;
    const box = this._box(corners);
    if (box !== null) this.centre = [this.width - box.x, this.height - box.y + 2];
    this.distance *= this.zoom;
  }

  /** Shift the view to the vehicle as the user zooms in. */
  _approach(position) {
    const k = Math.max(0, Math.min(1, (0.85 - this.zoom) / 0.35));
    this.target = mix(this.target, position, k);
    this.centre = [this.centre[0] * (1 - k) + (this.width / 2) * k, this.centre[1] * (1 - k) + (this.height / 2) * k];
  }

  /** Bounding box of points on the screen; null if a point is behind the eye. */
  _box(points) {
    this._axes();
    const places = points.map((point) => this.project(point));
    if (places.includes(null)) return null;
    const [x, y] = [0, 1].map((axis) => places.map((place) => place[axis]));
    const [left, right, top, bottom] = [Math.min(...x), Math.max(...x), Math.min(...y), Math.max(...y)];
    return { wide: right - left, high: bottom - top, x: (left + right) / 2, y: (top + bottom) / 2 };
  }

  /** Camera coordinates of a point: (right, up, depth). */
  seen(point) {
    const away = sub(point, this.eye);
    return [dot(away, this.right), dot(away, this.up), dot(away, this.forward)];
  }

  /** Screen position of camera coordinates, and pixels per metre there. */
  place([right, up, depth]) {
    const k = this.focal / depth;
    return [this.centre[0] + right * k, this.centre[1] - up * k, k];
  }

  /** Screen position of a point, or null if it is behind the eye. */
  project(point) {
    const seen = this.seen(point);
    return seen[2] < NEAR_M ? null : this.place(seen);
  }

  /** A polyline on the screen, split into the pieces in front of the eye. */
  trace(points) {
    const pieces = [];
    let piece = [];
    let last = null;
    for (const point of points) {
      const now = this.seen(point);
      if (last !== null && now[2] < NEAR_M !== last[2] < NEAR_M) {
        const k = (NEAR_M - last[2]) / (now[2] - last[2]);
        const edge = [last[0] + (now[0] - last[0]) * k, last[1] + (now[1] - last[1]) * k, NEAR_M];
        piece.push(this.place(edge));
      }
      if (now[2] >= NEAR_M) {
        piece.push(this.place(now));
      } else if (piece.length > 0) {
        pieces.push(piece);
        piece = [];
      }
      last = now;
    }
    if (piece.length > 0) pieces.push(piece);
    return pieces;
  }

  turn(yaw, pitch) {
    this.yaw -= yaw;
    this.pitch = Math.max(rad(-20), Math.min(PITCH_MAX, this.pitch + pitch));
    this.preset = null;
  }

  scaleBy(factor) {
    if (this.fits) this.zoom = Math.max(0.15, Math.min(3, this.zoom * factor));
    else this.distance = Math.max(0.6, Math.min(20, this.distance * factor));
  }
}

/** Attach the controls of the camera; `changed` is called after each move. */
export function steer(camera, canvas, changed) {
  const fingers = new Map();
  let spread = 0;
  const apart = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (fingers.size === 2) spread = apart();
  });
  canvas.addEventListener("pointermove", (event) => {
    const finger = fingers.get(event.pointerId);
    if (!finger) return;
    const [dx, dy] = [event.clientX - finger.x, event.clientY - finger.y];
    finger.x = event.clientX;
    finger.y = event.clientY;
    if (fingers.size === 1) {
      camera.turn(dx * 0.008, dy * 0.008);
    } else if (fingers.size === 2) {
      const wide = apart();
      if (wide > 0 && spread > 0) camera.scaleBy(spread / wide);
      spread = wide;
    }
    changed();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.scaleBy(Math.exp(Math.max(-120, Math.min(120, event.deltaY)) * 0.0015));
    changed();
  }, { passive: false });
  const keys = {
    ArrowLeft: () => camera.turn(-0.1, 0), ArrowRight: () => camera.turn(0.1, 0), ArrowUp: () => camera.turn(0, 0.08), ArrowDown: () => camera.turn(0, -0.08),
    "+": () => camera.scaleBy(0.9), "=": () => camera.scaleBy(0.9), "-": () => camera.scaleBy(1.1),
  };
  canvas.addEventListener("keydown", (event) => {
    const act = keys[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    act();
    changed();
  });
}
