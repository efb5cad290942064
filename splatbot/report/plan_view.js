// Points of a map and the balls of an arm, drawn far to near on a canvas; drag turns, wheel zooms, the slider is time.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
const points = new Float32Array(bytes(data.points)), colors = new Uint8Array(bytes(data.colors));
const balls = new Float32Array(bytes(data.balls)), radii = data.radii, tool = new Float32Array(bytes(data.tool));
const canvas = document.getElementById("view"), slider = document.getElementById("time"), label = document.getElementById("label");
const pen = canvas.getContext("2d"), count = points.length / 3, parts = radii.length, steps = data.times.length;
let yaw = 3.6, pitch = 0.5, distance = data.distance, playing = false;
slider.max = steps - 1;

function basis() {  // camera axes in the world of z up
  const c = Math.cos(pitch), s = Math.sin(pitch), a = Math.cos(yaw), b = Math.sin(yaw);
  return [[-b, a, 0], [s * a, s * b, -c], [-c * a, -c * b, -s]];
}

function draw() {
  const w = (canvas.width = canvas.clientWidth), h = (canvas.height = canvas.clientHeight), f = 0.9 * Math.min(w, h);
  const [x, y, z] = basis(), m = data.middle, at = Number(slider.value);
  const shown = [];
  const put = (px, py, pz, radius, r, g, b) => {
    const d = [px - m[0], py - m[1], pz - m[2]];
    const depth = distance + d[0] * z[0] + d[1] * z[1] + d[2] * z[2];
    if (depth < 0.05) return;
    const u = w / 2 + (f * (d[0] * x[0] + d[1] * x[1] + d[2] * x[2])) / depth;
    const v = h / 2 + (f * (d[0] * y[0] + d[1] * y[1] + d[2] * y[2])) / depth;
    const size = (f * radius) / depth;
    if (u > -size && v > -size && u < w + size && v < h + size) shown.push([depth, u, v, size, r, g, b]);
  };
  for (let i = 0; i < count; ++i) {
    put(points[3 * i], points[3 * i + 1], points[3 * i + 2], data.size, colors[3 * i], colors[3 * i + 1], colors[3 * i + 2]);
  }
  for (let i = 0; i < parts; ++i) {
    const k = 3 * (at * parts + i);
    put(balls[k], balls[k + 1], balls[k + 2], radii[i], 230, 230, 235);
  }
  for (let i = 0; i < steps; ++i) put(tool[3 * i], tool[3 * i + 1], tool[3 * i + 2], 0.005, 240, 120, 30);
  shown.sort((a, b) => b[0] - a[0]);
  pen.fillStyle = "#16181d";
  pen.fillRect(0, 0, w, h);
  for (const [, u, v, size, r, g, b] of shown) {
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
  label.textContent = `${data.times[at].toFixed(2)} s of ${data.times[steps - 1].toFixed(2)} s, room ${(1e3 * data.rooms[at]).toFixed(0)} mm`;
}

let held = null;
canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
canvas.addEventListener("pointerup", () => { held = null; });
canvas.addEventListener("pointermove", (e) => {
  if (!held) return;
  yaw -= 0.01 * (e.clientX - held[0]);
  pitch = Math.max(-1.5, Math.min(1.5, pitch + 0.01 * (e.clientY - held[1])));
  held = [e.clientX, e.clientY];
  draw();
});
canvas.addEventListener("wheel", (e) => { e.preventDefault(); distance *= Math.exp(0.001 * e.deltaY); draw(); }, { passive: false });
slider.addEventListener("input", draw);
document.getElementById("play").addEventListener("click", () => { playing = !playing; });
setInterval(() => {
  if (!playing) return;
  slider.value = (Number(slider.value) + 1) % steps;
  draw();
}, 60);
window.addEventListener("resize", draw);
draw();
