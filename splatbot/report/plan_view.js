// Draws the points of a map, the meshes or the certified spheres of an arm, and the path of its tool.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
const points = new Float32Array(bytes(data.points)), colors = new Uint8Array(bytes(data.colors));
const spheres = new Float32Array(bytes(data.spheres)), radii = data.radii, tool = new Float32Array(bytes(data.tool));
const corners = new Float32Array(bytes(data.corners)), link = new Uint16Array(bytes(data.link));
const shades = new Uint8Array(bytes(data.shades)), poses = new Float32Array(bytes(data.poses)), links = data.links;
const certified = document.getElementById("toggle");
certified.addEventListener("change", () => draw());

function scene(drawPoint, at, drawTriangle) {
  for (let i = 0; i < points.length; i += 3) {
    drawPoint(points[i], points[i + 1], points[i + 2], data.size, colors[i], colors[i + 1], colors[i + 2]);
  }
  if (certified.checked) {
    for (let i = 0; i < radii.length; ++i) {
      const k = 3 * (at * radii.length + i);
      drawPoint(spheres[k], spheres[k + 1], spheres[k + 2], radii[i], 230, 230, 235);
    }
  } else {
    for (let i = 0; i < link.length; ++i) {
      const k = 12 * (at * links + link[i]);  // rows of (R | t)
      const [a, b, c] = [0, 3, 6].map((o) => [0, 4, 8].map((r) =>
        poses[k + r] * corners[9 * i + o] + poses[k + r + 1] * corners[9 * i + o + 1] + poses[k + r + 2] * corners[9 * i + o + 2] + poses[k + r + 3]));
      drawTriangle(a, b, c, shades.subarray(3 * i, 3 * i + 3), 1);
    }
  }
  for (let i = 0; i < tool.length; i += 3) drawPoint(tool[i], tool[i + 1], tool[i + 2], 0.005, 240, 120, 30);
}

function caption(at) {
  return `clearance ${(1e3 * data.clearances[at]).toFixed(0)} mm`;
}
