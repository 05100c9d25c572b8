// spz.mjs PACKAGES FILE OUT: the values of a .spz by @adobe/spz, in the file's own axes. OUT gets
// positions, scales, rotations (x, y, z, w), alphas, colours and SH one after the other, float32.
import { readFileSync, writeFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';

const [packages, file, out] = process.argv.slice(2);
const library = await import(pathToFileURL(`${packages}/@adobe/spz/dist/spz.js`).href);
const spz = await library.default();
const cloud = spz.loadSpzFromBuffer(new Uint8Array(readFileSync(file)), {
  to: spz.CoordinateSystem.UNSPECIFIED,
});
const parts = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'];
writeFileSync(out, Buffer.concat(parts.map((name) => {
  const values = cloud[name];
  return Buffer.from(values.buffer, values.byteOffset, values.byteLength);
})));
console.log(JSON.stringify({ count: cloud.numPoints, degree: cloud.shDegree }));
