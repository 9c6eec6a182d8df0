// Plays the movie of a flight on a canvas: pictures of shapes in pixels, made by companion/analysis/animation.py.

(() => {
  const { width, height, split, frames_per_s, styles, axes, curves, frames, still } = JSON.parse(document.getElementById("movie").textContent);
  const [canvas, button, slider] = ["canvas", "button", "input"].map((name) => document.querySelector(`#player ${name}`));
  const context = canvas.getContext("2d");
  let shown = still;
  let since = null;

  function draw([style, ...values], limit = Infinity) {
    const [colour, thick, alpha, align] = styles[style];
    const text = align ? values.pop() : null;
    const points = [];
    for (let k = 0; k + 1 < values.length; k += 2) if (values[k] <= 5 * limit) points.push([values[k] / 5, values[k + 1] / 5]);
    if (points.length === 0) return;
    context.globalAlpha = alpha;
    context.fillStyle = context.strokeStyle = colour;
    context.lineWidth = thick;
    if (text !== null) {
      context.font = `${thick}px system-ui, sans-serif`;
      context.textAlign = align;
      context.fillText(text, ...points[0]);
      return;
    }
    context.beginPath();
    for (const [x, y] of points) context.lineTo(x, y);
    if (thick > 0 && points.length > 1) context.stroke();
    else if (thick === 0) context.fill();
    if (points.length > 1 && limit === Infinity) return;
    context.beginPath();
    context.arc(...points.at(-1), limit < Infinity ? 4 : thick / 2, 0, 2 * Math.PI);
    context.fill();
  }

  function show(k) {
    shown = k;
    slider.value = k;
    const scale = Math.max(1, Math.min(3, devicePixelRatio * 1.25));
    if (canvas.width !== Math.round(width * scale)) [canvas.width, canvas.height] = [Math.round(width * scale), Math.round(height * scale)];
    context.setTransform(scale, 0, 0, scale, 0, 0);
    context.lineJoin = context.lineCap = "round";
    context.textBaseline = "middle";
    context.clearRect(0, 0, width, height);
    const [limit, ...shapes] = frames[k];
    for (const shape of shapes) draw(shape);
    context.clearRect(split, 0, width - split, height);
    for (const shape of axes) draw(shape);
    for (const curve of curves) draw(curve, limit);
  }

  function play(from) {
    since = from === null ? null : performance.now() - (1000 * from) / frames_per_s;
    button.textContent = from === null ? "Play" : "Pause";
    if (from !== null) requestAnimationFrame(step);
  }

  function step(now) {
    if (since === null) return;
    const k = Math.floor(((now - since) * frames_per_s) / 1000);
    if (k >= frames.length + 20) since = now;
    const next = Math.max(0, Math.min(k, frames.length - 1));
    if (next !== shown) show(next);
    requestAnimationFrame(step);
  }

  slider.max = frames.length - 1;
  slider.addEventListener("input", () => { play(null); show(Number(slider.value)); });
  button.addEventListener("click", () => play(since === null ? (shown < frames.length - 1 ? shown : 0) : null));
  show(still);
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) play(0);
})();
