// Draws the points of a map and of simulated bodies, the path of the tool, the contacts, and a curve of the clearance of the arm.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
const points = new Float32Array(bytes(data.points)), colors = new Uint8Array(bytes(data.colors));
const own = new Float32Array(bytes(data.own)), tints = new Uint8Array(bytes(data.tints)), body = new Uint16Array(bytes(data.body));
const poses = new Float32Array(bytes(data.poses)), soft = new Float32Array(bytes(data.soft)), bodyCount = data.bodies;
const normals = new Int8Array(bytes(data.normals)), path = new Float32Array(bytes(data.path));
const chart = document.getElementById("curve"), sun = [-0.35, -0.35, 0.87];  // direction to the light

function scene(drawPoint, at) {
  for (let i = 0; i < points.length; i += 3) {
    drawPoint(points[i], points[i + 1], points[i + 2], data.size, colors[i], colors[i + 1], colors[i + 2]);
  }
  for (let i = 0; i < body.length; ++i) {
    const k = 12 * (at * bodyCount + body[i]), x = own[3 * i], y = own[3 * i + 1], z = own[3 * i + 2];  // rows of (R | t)
    const [px, py, pz] = [0, 4, 8].map((r) => poses[k + r] * x + poses[k + r + 1] * y + poses[k + r + 2] * z + poses[k + r + 3]);
    const n = [0, 4, 8].map((r) => (poses[k + r] * normals[3 * i] + poses[k + r + 1] * normals[3 * i + 1] + poses[k + r + 2] * normals[3 * i + 2]) / 127);
    const light = 0.4 + 0.6 * Math.max(0, n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2]);
    drawPoint(px, py, pz, data.size, light * tints[3 * i], light * tints[3 * i + 1], light * tints[3 * i + 2]);
  }
  for (let i = 0; i < path.length; i += 3) drawPoint(path[i], path[i + 1], path[i + 2], 0.004, ...data.pathColor);
  const corners = soft.length / data.times.length;
  for (let i = at * corners; i < (at + 1) * corners; i += 3) drawPoint(soft[i], soft[i + 1], soft[i + 2], 0.008, 120, 200, 140);
  for (const [x, y, z, force] of data.contacts[at]) drawPoint(x, y, z, 0.008 + 0.0004 * Math.min(50, force), 255, 60, 60);
  curve(at);
}

function caption(at) {
  const maxForce = data.contacts[at].reduce((most, contact) => Math.max(most, contact[3]), 0);
  const contact = data.contacts[at].length ? `, contact force ${maxForce.toFixed(1)} N` : "";
  const clearance = data.clearances[at] >= data.far ? `${(1e3 * data.far).toFixed(0)} mm or more` : `${(1e3 * data.clearances[at]).toFixed(1)} mm`;
  return `clearance ${clearance}${contact}`;
}

function curve(at) {
  const w = (chart.width = chart.clientWidth), h = (chart.height = chart.clientHeight), pen = chart.getContext("2d");
  const last = data.times.length - 1, least = Math.min(0, ...data.clearances);
  const x = (i) => (last ? (w * i) / last : 0), y = (clearance) => 4 + (h - 8) * (1 - (clearance - least) / (data.far - least));
  pen.fillStyle = styled("--page");
  pen.fillRect(0, 0, w, h);
  pen.fillStyle = "rgba(255,60,60,0.35)";
  data.contacts.forEach((found, i) => { if (found.length) pen.fillRect(x(i) - 0.5 * x(1), 0, Math.max(1, x(1)), h); });
  const line = (style, from, to) => { pen.strokeStyle = style; pen.beginPath(); pen.moveTo(...from); pen.lineTo(...to); pen.stroke(); };
  line(styled("--line"), [0, y(0)], [w, y(0)]);
  pen.strokeStyle = styled("--curve");
  pen.beginPath();
  data.clearances.forEach((clearance, i) => (i ? pen.lineTo(x(i), y(clearance)) : pen.moveTo(x(i), y(clearance))));
  pen.stroke();
  line(styled("--ink"), [x(at), 0], [x(at), h]);
}
chart.addEventListener("click", (e) => step(Math.round((e.offsetX / chart.clientWidth) * (data.times.length - 1)) - Number(document.getElementById("time").value)));
