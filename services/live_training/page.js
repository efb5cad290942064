// Shows a training: sends the view that is wanted, and draws the messages of the server. A hidden page closes its
// connection, so that it costs nothing. Camera axes are OpenCV's; poses are T_world_camera, row by row.
"use strict";
const at = (id) => document.getElementById(id);
const SEND_MS = 50, RETRY_MS = 2000, WIDEST = 1024, TURN = 0.006, KEY_TURN = 0.1;
let socket = null, scene = null, latest = null, ended = false, drawn = null;
let view = 0, pose = null, pivot = null, distance = 1, unsent = false, sentAt = 0;

// Vectors and rotations.
const add = (a, b, k = 1) => a.map((value, i) => value + k * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const axis = (T, i) => [T[i], T[4 + i], T[8 + i]];  // column i of a pose
const posed = (x, y, z, eye) => [x[0], y[0], z[0], eye[0], x[1], y[1], z[1], eye[1], x[2], y[2], z[2], eye[2], 0, 0, 0, 1];
const turned = (v, n, angle) =>  // v rotated about n (Rodrigues)
  add(add(v.map((value) => value * Math.cos(angle)), cross(n, v), Math.sin(angle)), n, dot(n, v) * (1 - Math.cos(angle)));

// Connection.
function connect() {
  if (ended || document.hidden || socket) return;
  const own = (socket = new WebSocket(`ws://${location.host}/live`));
  own.onmessage = (event) => {
    const message = JSON.parse(event.data);
    receive[message.kind](message);
  };
  own.onclose = () => {
    if (socket === own) socket = null;
    if (ended || document.hidden) return;
    say("The training does not answer; trying again.", true);
    setTimeout(connect, RETRY_MS);
  };
}
document.addEventListener("visibilitychange", () => {
  if (document.hidden && socket) socket.close();
  else connect();
});

const receive = {
  scene(message) {
    const first = scene === null;
    scene = message;
    at("name").textContent = `Training ${scene.name}`;
    document.title = `${scene.name} · splatbot`;
    const groups = [["training", scene.views.slice(0, scene.trained)], ["held out", scene.views.slice(scene.trained)]];
    let number = 0;
    at("view").replaceChildren(...groups.filter(([, views]) => views.length).map(([label, views]) => {
      const group = Object.assign(document.createElement("optgroup"), {label: `${label} (${views.length})`});
      group.append(...views.map(([name]) => new Option(name, number++)));
      return group;
    }));
    if (first) choose(scene.trained < scene.views.length ? scene.trained : 0);
    else request();  // after a pause
  },
  status(message) {
    latest = message;
    ended = latest.ended;
    if (ended) socket.close();
    showStatus();
  },
  photo(message) {
    if (message.view === view) showImage("photo", message.image);
  },
  picture(message) {
    if (message.view !== view || (message.own_pose && pose)) return;
    drawn = message;
    showImage("picture", message.image);
    at("drawn").textContent = `The map at iteration ${count(message.iteration)}, drawn ${message.width} px wide.`;
  },
  problem(message) { say(message.text, true); },
};

function showImage(id, data) {
  at(id).src = `data:image/jpeg;base64,${data}`;
  at(id).hidden = false;
}

function request() {
  unsent = true;
  setTimeout(send, Math.max(0, sentAt + SEND_MS - performance.now()));
}

function send() {
  if (!unsent || !scene || !socket || socket.readyState !== WebSocket.OPEN) return;
  if (socket.bufferedAmount) {
    setTimeout(send, SEND_MS);
    return;
  }
  unsent = false;
  sentAt = performance.now();
  const wanted = Math.round(at("orbit").clientWidth * Math.min(devicePixelRatio, 2));
  socket.send(JSON.stringify({view, width: Math.max(1, Math.min(WIDEST, wanted)), pose}));
}

// Cameras.
function choose(number) {
  if (number !== view) at("photo").hidden = at("picture").hidden = true;
  view = number;
  at("view").value = view;
  const [name, width, height] = scene.views[view];
  for (const frame of document.querySelectorAll(".frame")) frame.style.aspectRatio = `${width} / ${height}`;
  at("taken").textContent = `${name}, ${view < scene.trained ? "a training view" : "a held-out view"}.`;
  at("drawn").textContent = "The map. Drag to turn it, scroll to zoom, drag with Shift to move it.";
  drawn = null;
  reset();
}

function reset() {
  pose = pivot = null;
  at("reset").disabled = true;
  request();
}

at("view").onchange = () => choose(Number(at("view").value));
const step = (by) => scene && choose((view + by + scene.views.length) % scene.views.length);
at("previous").onclick = () => step(-1);
at("next").onclick = () => step(1);
at("reset").onclick = reset;

// Orbit: the camera turns about the surface that was in the middle of its picture.
function grasp() {
  if (pivot) return true;
  if (!drawn) return false;
  distance = drawn.distance;
  pose = drawn.pose;
  pivot = add([pose[3], pose[7], pose[11]], axis(pose, 2), distance);
  at("reset").disabled = false;
  return true;
}

function turn(yaw, pitch) {
  if (!grasp()) return;
  const up = scene.up;
  const x = turned(axis(pose, 0), up, yaw), z = turned(axis(pose, 2), up, yaw);
  let down = turned(z, x, pitch);
  if (Math.abs(dot(down, up)) > 0.995 && Math.abs(dot(down, up)) > Math.abs(dot(z, up))) down = z;  // not over the pole
  place(x, down);
}

function place(x, z) {
  const y = unit(cross(z, x));
  pose = posed(unit(cross(y, z)), y, unit(z), add(pivot, unit(z), -distance));
  request();
}

function zoom(factor) {
  if (!grasp()) return;
  distance *= factor;
  place(axis(pose, 0), axis(pose, 2));
}

function pan(right, down) {  // shares of the width of the image
  if (!grasp()) return;
  const [, width, , focal] = scene.views[view], metres = distance * width / focal;
  pivot = add(add(pivot, axis(pose, 0), -right * metres), axis(pose, 1), -down * metres);
  place(axis(pose, 0), axis(pose, 2));
}

const orbit = at("orbit"), fingers = new Map();
orbit.onpointerdown = (event) => {
  orbit.setPointerCapture(event.pointerId);
  orbit.classList.add("dragged");
  fingers.set(event.pointerId, event);
};
orbit.onpointerup = orbit.onpointercancel = (event) => {
  fingers.delete(event.pointerId);
  orbit.classList.toggle("dragged", fingers.size > 0);
};
orbit.onpointermove = (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  fingers.set(event.pointerId, event);
  const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY, side = orbit.clientWidth;
  if (fingers.size === 2) {
    const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
    const span = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY) || 1;
    zoom(span(before) / span(event));
    pan(dx / side / 2, dy / side / 2);
  } else if (event.shiftKey || event.buttons & 6) pan(dx / side, dy / side);
  else turn(-dx * TURN, -dy * TURN);
};
orbit.oncontextmenu = (event) => event.preventDefault();
orbit.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.003));
}, {passive: false});
orbit.onkeydown = (event) => {
  const keys = {
    ArrowLeft: () => turn(KEY_TURN, 0), ArrowRight: () => turn(-KEY_TURN, 0),
    ArrowUp: () => turn(0, KEY_TURN), ArrowDown: () => turn(0, -KEY_TURN),
    "+": () => zoom(0.9), "-": () => zoom(1.1), Home: reset,
  };
  if (!keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
};
addEventListener("resize", () => { request(); if (latest) showStatus(); });

// Numbers and curves.
const count = (value) => Math.round(value).toLocaleString("en");
const short = (value) => {
  const size = Math.abs(value);
  return size >= 1e6 ? `${+(value / 1e6).toPrecision(3)}M` : size >= 1e4 ? `${+(value / 1e3).toPrecision(3)}k` : `${+value.toPrecision(3)}`;
};
const clock = (s) => s >= 3600 ? `${Math.floor(s / 3600)} h ${Math.floor(s / 60) % 60} min` : `${Math.floor(s / 60)}:${String(Math.floor(s) % 60).padStart(2, "0")}`;
const percent = (share) => `${(100 * share).toFixed(1)} %`;

function say(text, lost = false) {
  at("state").textContent = text;
  at("state").classList.toggle("lost", lost);
}

function showStatus() {
  const {course, psnr} = latest, last = course[course.length - 1];
  say(ended
    ? "The training has ended; the page keeps its last state. The scores follow in the terminal."
    : `${percent(latest.share)} done, ${clock(latest.seconds)} of training`);
  at("done").style.width = `${100 * latest.share}%`;
  at("done").parentElement.setAttribute("aria-valuenow", Math.round(100 * latest.share));
  at("iteration").textContent = count(latest.iteration);
  at("gaussians").textContent = count(latest.gaussians);
  at("loss").textContent = last && last[1] !== null ? last[1].toFixed(4) : "–";
  at("rate").textContent = last ? short(last[3]) : "–";
  at("psnr").textContent = psnr.length ? `${psnr[psnr.length - 1][1].toFixed(2)} dB` : "–";
  at("left").textContent = ended ? "–" : clock(latest.remaining_s);
  at("share").textContent = `This page has taken ${percent(latest.viewer_share)} of the time so far; it takes at most ${percent(latest.most_viewer_share)}.`;
  chart("loss-chart", course.map((p) => [p[0], p[1]]));
  chart("psnr-chart", psnr, true);
  chart("gaussians-chart", course.map((p) => [p[0], p[2]]));
  chart("rate-chart", course.map((p) => [p[0], p[3]]));
}

function node(name, attributes, text = "") {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

function ticks(low, high, most) {  // round numbers within a range
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const size = [1, 2, 5, 10].map((k) => k * power).find((value) => value >= rough);
  const found = [];
  for (let k = Math.ceil(low / size - 1e-9); k * size <= high + 1e-9 * size; k++) found.push(k * size);
  return found;
}

function chart(id, points, dots = false) {
  const svg = at(id), known = points.filter((p) => p[1] !== null), w = svg.clientWidth, h = svg.clientHeight;
  if (!known.length) {
    svg.replaceChildren(node("text", {x: 0, y: 20}, scene && id === "psnr-chart" && scene.trained === scene.views.length
      ? "There are no held-out views." : "No value yet."));
    return;
  }
  const left = 46, bottom = 22, top = 8, right = 8;
  const values = known.map((p) => p[1]), least = Math.min(...values), greatest = Math.max(...values);
  const margin = 0.08 * (greatest - least) || 0.05 * Math.abs(greatest) || 1;
  const low = least >= 0 ? Math.max(0, least - margin) : least - margin, high = greatest + margin;
  const end = Math.max(latest.seconds, known[known.length - 1][0], 1e-3);
  const x = (t) => left + (w - left - right) * t / end, y = (v) => top + (h - top - bottom) * (high - v) / (high - low);
  const minutes = end > 180, per = minutes ? 60 : 1;
  const lines = ticks(low, high, 4).flatMap((v) => [
    node("line", {class: "grid", x1: left, x2: w - right, y1: y(v), y2: y(v)}),
    node("text", {x: left - 6, y: y(v) + 4, "text-anchor": "end"}, short(v)),
  ]);
  const times = ticks(0, end / per, 5).map((t) => node("text", {x: x(t * per), y: h - 4, "text-anchor": "middle"}, short(t)));
  times[times.length - 1].textContent += minutes ? " min" : " s";
  const marks = dots || known.length === 1 ? known.map(([t, v]) => node("circle", {class: "dot", cx: x(t), cy: y(v), r: 3})) : [];
  const path = known.map(([t, v], i) => `${i ? "L" : "M"}${x(t).toFixed(1)} ${y(v).toFixed(1)}`).join("");
  svg.replaceChildren(...lines, ...times, node("path", {class: "curve", d: path}), ...marks);
}

connect();
