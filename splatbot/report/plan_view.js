// Draws the points of a map, the spheres of an arm and the path of its tool.
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
const points = new Float32Array(bytes(data.points)), colors = new Uint8Array(bytes(data.colors));
const spheres = new Float32Array(bytes(data.spheres)), radii = data.radii, tool = new Float32Array(bytes(data.tool));

function scene(drawPoint, at) {
  for (let i = 0; i < points.length; i += 3) {
    drawPoint(points[i], points[i + 1], points[i + 2], data.size, colors[i], colors[i + 1], colors[i + 2]);
  }
  for (let i = 0; i < radii.length; ++i) {
    const k = 3 * (at * radii.length + i);
    drawPoint(spheres[k], spheres[k + 1], spheres[k + 2], radii[i], 230, 230, 235);
  }
  for (let i = 0; i < tool.length; i += 3) drawPoint(tool[i], tool[i + 1], tool[i + 2], 0.005, 240, 120, 30);
}

function caption(at) {
  return `clearance ${(1e3 * data.clearances[at]).toFixed(0)} mm`;
}
