// Draws the points of a map and of simulated bodies, the path of the tool, the contacts, and curves of the clearance of
// the arm and of the rise of the target.
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
  for (const [found, color] of [[data.grips[at], data.gripColor], [data.contacts[at], data.contactColor]]) {
    for (const [x, y, z, force] of found) drawPoint(x, y, z, 0.008 + 0.0004 * Math.min(50, force), ...color);
  }
  curve(at);
}

function caption(at) {
  const force = (name, found) => (found.length ? `, ${name} force ${Math.max(...found.map((contact) => contact[3])).toFixed(1)} N` : "");
  const clearance = data.clearances[at] >= data.far ? `${(1e3 * data.far).toFixed(0)} mm or more` : `${(1e3 * data.clearances[at]).toFixed(1)} mm`;
  const rise = data.rises.length ? `, target risen by ${(1e3 * data.rises[at]).toFixed(0)} mm` : "";
  return `${data.clearanceName} ${clearance}${rise}${force("contact", data.contacts[at])}${force("grip", data.grips[at])}`;
}

const area = { left: 48, right: 8, top: 14, bottom: 18 };  // margins of the curves in their canvas [px]

function ticks(low, high, most) {  // round values between low and high
  const least = (high - low) / most, power = 10 ** Math.floor(Math.log10(least));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= least);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; ++k) found.push(k * step);
  return found;
}

function curve(at) {
  const w = (chart.width = chart.clientWidth), h = (chart.height = chart.clientHeight), pen = chart.getContext("2d");
  const last = data.times.length - 1, begin = data.times[0], end = Math.max(data.times[last], begin + 1e-3);
  const low = Math.min(0, ...data.clearances, ...data.rises), high = Math.max(data.far, ...data.rises);
  const x = (time) => area.left + ((w - area.left - area.right) * (time - begin)) / (end - begin);
  const y = (height) => area.top + (h - area.top - area.bottom) * (1 - (height - low) / (high - low));
  const line = (style, from, to) => { pen.strokeStyle = style; pen.beginPath(); pen.moveTo(...from); pen.lineTo(...to); pen.stroke(); };
  const text = (words, u, v, align) => { pen.textAlign = align; pen.fillText(words, u, v); };
  pen.fillStyle = styled("--page");
  pen.fillRect(0, 0, w, h);
  pen.fillStyle = `rgba(${data.contactColor}, 0.35)`;
  const wide = Math.max(1, (x(end) - x(begin)) / Math.max(1, last));
  data.contacts.forEach((found, i) => { if (found.length) pen.fillRect(x(data.times[i]) - wide / 2, area.top, wide, h - area.top - area.bottom); });
  pen.fillStyle = styled("--ink");
  pen.font = "11px system-ui, sans-serif";
  for (const value of ticks(1e3 * low, 1e3 * high, 4)) {
    line(styled("--line"), [x(begin), y(value / 1e3)], [x(end), y(value / 1e3)]);
    text(value.toFixed(0), area.left - 6, y(value / 1e3) + 4, "right");
  }
  for (const value of ticks(begin, end, Math.max(2, w / 90))) text(+value.toFixed(3), x(value), h - 5, "center");
  text("[mm]", area.left - 6, 9, "right");
  text("time [s]", w - area.right, 9, "right");
  for (const [values, style] of [[data.clearances, styled("--curve")], [data.rises, data.riseColor]]) {
    pen.strokeStyle = style;
    pen.beginPath();
    values.forEach((value, i) => (i ? pen.lineTo(x(data.times[i]), y(value)) : pen.moveTo(x(data.times[i]), y(value))));
    pen.stroke();
  }
  line(styled("--ink"), [x(data.times[at]), area.top], [x(data.times[at]), h - area.bottom]);
}
chart.addEventListener("click", (e) => {
  const share = (e.offsetX - area.left) / (chart.clientWidth - area.left - area.right);
  step(Math.round(Math.min(1, Math.max(0, share)) * (data.times.length - 1)) - Number(document.getElementById("time").value));
});
