// Draws points and triangles far to near on a canvas and animates them: drag rotates, wheel zooms, the slider scrubs; buttons, space and
// arrow keys play and step; #t=1.5 at the end of the address starts at that time [s]. The page's own script runs first and
// defines scene(drawPoint, at, drawTriangle), which draws time step `at`, and caption(at).
"use strict";
const canvas = document.getElementById("view"), slider = document.getElementById("time"), label = document.getElementById("label");
const pen = canvas.getContext("2d"), steps = data.times.length, button = document.getElementById("play");
const styled = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);
let yaw = data.yaw, pitch = 0.5, distance = data.distance, playing = false;
slider.max = steps - 1;

function basis() {  // camera axes in a z-up world
  const c = Math.cos(pitch), s = Math.sin(pitch), a = Math.cos(yaw), b = Math.sin(yaw);
  return [[-b, a, 0], [s * a, s * b, -c], [-c * a, -c * b, -s]];
}

function draw() {
  const w = (canvas.width = canvas.clientWidth), h = (canvas.height = canvas.clientHeight), f = 0.9 * Math.min(w, h);
  const [x, y, z] = basis(), m = data.middle, at = Number(slider.value);
  const shown = [];
  const drawPoint = (px, py, pz, radius, r, g, b) => {
    const d = [px - m[0], py - m[1], pz - m[2]];
    const depth = distance + d[0] * z[0] + d[1] * z[1] + d[2] * z[2];
    if (depth < 0.05) return;
    const u = w / 2 + (f * (d[0] * x[0] + d[1] * x[1] + d[2] * x[2])) / depth;
    const v = h / 2 + (f * (d[0] * y[0] + d[1] * y[1] + d[2] * y[2])) / depth;
    const size = (f * radius) / depth;
    if (u > -size && v > -size && u < w + size && v < h + size) shown.push([depth, u, v, size, r, g, b]);
  };
  const project = (px, py, pz) => {
    const d = [px - m[0], py - m[1], pz - m[2]];
    const depth = distance + d[0] * z[0] + d[1] * z[1] + d[2] * z[2];
    return [w / 2 + (f * (d[0] * x[0] + d[1] * x[1] + d[2] * x[2])) / depth, h / 2 + (f * (d[0] * y[0] + d[1] * y[1] + d[2] * y[2])) / depth, depth];
  };
  const drawTriangle = (a, b, c, shade, alpha) => {  // corners [x, y, z] m; lit from the camera
    const p = project(...a), q = project(...b), r = project(...c);
    if (Math.min(p[2], q[2], r[2]) < 0.05) return;
    const e = [b[0] - a[0], b[1] - a[1], b[2] - a[2]], g = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
    const n = [e[1] * g[2] - e[2] * g[1], e[2] * g[0] - e[0] * g[2], e[0] * g[1] - e[1] * g[0]];
    const light = Math.abs(n[0] * z[0] + n[1] * z[1] + n[2] * z[2]) / (Math.hypot(...n) || 1), k = 0.35 + 0.65 * light;
    shown.push([(p[2] + q[2] + r[2]) / 3, p, q, r, k * shade[0], k * shade[1], k * shade[2], alpha]);
  };
  scene(drawPoint, at, drawTriangle);
  shown.sort((a, b) => b[0] - a[0]);
  pen.fillStyle = styled("--page");
  pen.fillRect(0, 0, w, h);
  for (const [, u, v, size, r, g, b, alpha] of shown) {
    if (alpha !== undefined) {
      pen.fillStyle = pen.strokeStyle = `rgba(${r},${g},${b},${alpha})`;
      pen.beginPath();
      for (const corner of [u, v, size]) pen.lineTo(corner[0], corner[1]);
      pen.closePath();
      pen.fill();
      pen.stroke();
      continue;
    }
    pen.fillStyle = `rgb(${r},${g},${b})`;
    if (size < 3) {
      const side = Math.max(1, 2 * size);
      pen.fillRect(u - side / 2, v - side / 2, side, side);
    } else {
      pen.beginPath();
      pen.arc(u, v, size, 0, 2 * Math.PI);
      pen.fill();
      pen.strokeStyle = "rgba(0,0,0,0.35)";
      pen.stroke();
    }
  }
  label.textContent = `${data.times[at].toFixed(2)} s of ${data.times[steps - 1].toFixed(2)} s, ${caption(at)}`;
}

function go(at) {
  slider.value = ((at % steps) + steps) % steps;
  draw();
}

function play(on) {
  playing = on;
  button.textContent = playing ? "pause" : "play";
}

function step(by) {
  play(false);
  go(Number(slider.value) + by);
}

let dragged = null;
canvas.addEventListener("pointerdown", (e) => { dragged = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
canvas.addEventListener("pointerup", () => { dragged = null; });
canvas.addEventListener("pointermove", (e) => {
  if (!dragged) return;
  yaw -= 0.01 * (e.clientX - dragged[0]);
  pitch = Math.max(-1.5, Math.min(1.5, pitch + 0.01 * (e.clientY - dragged[1])));
  dragged = [e.clientX, e.clientY];
  draw();
});
canvas.addEventListener("wheel", (e) => { e.preventDefault(); distance *= Math.exp(0.001 * e.deltaY); draw(); }, { passive: false });
slider.addEventListener("input", draw);
button.addEventListener("click", () => play(!playing));
document.getElementById("back").addEventListener("click", () => step(-1));
document.getElementById("on").addEventListener("click", () => step(1));
window.addEventListener("keydown", (e) => {
  if (e.target === slider && e.key !== " ") return;  // the slider handles these keys
  if (e.key === " ") play(!playing);
  else if (e.key === "ArrowLeft") step(-1);
  else if (e.key === "ArrowRight") step(1);
  else return;
  e.preventDefault();
});
setInterval(() => { if (playing) go(Number(slider.value) + 1); }, Math.max(30, (1000 * data.times[steps - 1]) / Math.max(1, steps - 1)));
window.addEventListener("resize", draw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
const begin = /#t=([0-9.]+)/.exec(location.hash);
const first = begin ? data.times.findIndex((t) => t >= Number(begin[1]) - 1e-9) : 0;
go(first < 0 ? steps - 1 : first);
