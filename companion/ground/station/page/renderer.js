// Draws lines, areas and labels of the world on a canvas, projected by a camera.

import { FONT, colours } from "./colours.js";

export class Renderer {
  constructor(context, camera) {
    this.context = context;
    this.camera = camera;
    context.lineJoin = "round";
    context.lineCap = "round";
  }

  line(points, colour, { width = 1.5, dash = [], alpha = 1 } = {}) {
    const { context } = this;
    context.globalAlpha = alpha;
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.setLineDash(dash);
    context.beginPath();
    for (const piece of this.camera.trace(points)) {
      context.moveTo(piece[0][0], piece[0][1]);
      for (let k = 1; k < piece.length; k += 1) context.lineTo(piece[k][0], piece[k][1]);
    }
    context.stroke();
    context.globalAlpha = 1;
  }

  area(points, colour, alpha = 1) {
    const pieces = this.camera.trace(points);
    if (pieces.length !== 1 || pieces[0].length < 3) return;
    const { context } = this;
    context.globalAlpha = alpha;
    context.fillStyle = colour;
    context.beginPath();
    pieces[0].forEach(([x, y], k) => (k === 0 ? context.moveTo(x, y) : context.lineTo(x, y)));
    context.closePath();
    context.fill();
    context.globalAlpha = 1;
  }

  /** Draw a ball with a radius in metres, and at least `least` pixels. */
  ball(point, radius_m, colour, { least = 1.5, alpha = 1, edge = null } = {}) {
    const at = this.camera.project(point);
    if (!at) return;
    const { context } = this;
    context.globalAlpha = alpha;
    context.fillStyle = colour;
    context.beginPath();
    context.arc(at[0], at[1], Math.max(least, radius_m * at[2]), 0, 2 * Math.PI);
    context.fill();
    if (edge) {
      context.setLineDash([]);
      context.strokeStyle = edge;
      context.lineWidth = 1.5;
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  /** Draw text next to a point; with `edge` on a plate. */
  text(point, text, { colour = colours.soft, edge = null, dx = 0, dy = 0, size = 12, align = "center" } = {}) {
    const at = this.camera.project(point);
    if (!at) return;
    const { context } = this;
    context.font = `${edge ? "700 " : ""}${size}px ${FONT}`;
    context.textBaseline = "middle";
    context.textAlign = align;
    let [x, y] = [at[0] + dx, at[1] + dy];
    if (edge) {
      const wide = context.measureText(text).width + 16;
      x = Math.max(wide / 2 + 4, Math.min(this.camera.width - wide / 2 - 4, x));
      y = Math.max(size + 4, Math.min(this.camera.height - size - 4, y));
      context.fillStyle = colours.card;
      context.strokeStyle = edge;
      context.lineWidth = 2;
      context.setLineDash([]);
      context.beginPath();
      context.roundRect(x - wide / 2, y - size * 0.85, wide, size * 1.7, 6);
      context.fill();
      context.stroke();
    }
    context.fillStyle = colour;
    context.fillText(text, x, y);
  }

  /** Draw an arrow. */
  arrow(from, to, colour, width = 3) {
    this.line([from, to], colour, { width });
    const [a, b] = [this.camera.project(from), this.camera.project(to)];
    if (!a || !b) return;
    const angle = Math.atan2(b[1] - a[1], b[0] - a[0]);
    const { context } = this;
    const size = 6 + width;
    context.fillStyle = colour;
    context.beginPath();
    context.moveTo(b[0] + size * 0.6 * Math.cos(angle), b[1] + size * 0.6 * Math.sin(angle));
    for (const turn of [2.55, -2.55]) context.lineTo(b[0] + size * Math.cos(angle + turn), b[1] + size * Math.sin(angle + turn));
    context.closePath();
    context.fill();
  }

  depth(point) {
    return this.camera.seen(point)[2];
  }
}
