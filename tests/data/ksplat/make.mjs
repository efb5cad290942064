// Writes level0.ksplat.gz to level2.ksplat.gz and decoded.json.gz by @mkkellogg/gaussian-splats-3d 0.4.7 (MIT):
// npm install @mkkellogg/gaussian-splats-3d@0.4.7 three && node make.mjs
import fs from 'node:fs';
import zlib from 'node:zlib';
globalThis.window ??= globalThis;
globalThis.document ??= {};
try { globalThis.navigator ??= { userAgent: '' }; } catch {}
const THREE = await import('three');
const { SplatBuffer, PlyParser, SplatBufferGenerator } = await import('@mkkellogg/gaussian-splats-3d');

const COUNT = [13, 8], DEGREE = 2, BUCKET = 4;  // Gaussians of two sections; full buckets have 4
let state = 1;
const random = (low, high) => {  // a linear congruential generator
    state = (1103515245 * state + 12345) % 2147483648;
    return low + (high - low) * state / 2147483648;
};
const splat = () => {
    const q = new THREE.Quaternion(random(-1, 1), random(-1, 1), random(-1, 1), random(-1, 1)).normalize();
    return [random(-1, 5.5), random(-1, 5.5), random(-1, 5.5), random(.01, .1), random(.01, .1), random(.01, .1),
            q.w, q.x, q.y, q.z, ...[0, 0, 0, 0].map(() => Math.floor(random(1, 255))),
            ...Array.from({ length: 24 }, () => random(-.5, .5))];
};
const sections = COUNT.map((count) => ({
    sphericalHarmonicsDegree: DEGREE, splatCount: count, splats: Array.from({ length: count }, splat),
}));
const decoded = [];
for (const level of [0, 1, 2]) {
    const made = SplatBuffer.generateFromUncompressedSplatArrays(
        sections, 1, level, new THREE.Vector3(), 5.0, BUCKET);
    fs.writeFileSync(`level${level}.ksplat.gz`, zlib.gzipSync(Buffer.from(made.bufferData), { level: 9 }));
    const n = made.getSplatCount(), read = new SplatBuffer(made.bufferData), rest = new Float32Array(24 * n);
    const center = new THREE.Vector3(), scale = new THREE.Vector3(), q = new THREE.Quaternion(), rgba = new THREE.Vector4();
    read.fillSphericalHarmonicsArray(rest, DEGREE, new THREE.Matrix4(), 0, n - 1, 0, 0);
    const rows = [];
    for (let i = 0; i < n; i++) {
        read.getSplatCenter(i, center); read.getSplatScaleAndRotation(i, scale, q); read.getSplatColor(i, rgba);
        rows.push({ mean: center.toArray(), scale: scale.toArray(), wxyz: [q.w, q.x, q.y, q.z], rgba: rgba.toArray(),
                    harmonics: [...rest.subarray(24 * i, 24 * i + 24)] });
    }
    decoded.push(rows);
}
const short = (key, value) => typeof value === 'number' ? Number(value.toPrecision(8)) : value;
fs.writeFileSync('decoded.json.gz', zlib.gzipSync(JSON.stringify(decoded, short), { level: 9 }));
