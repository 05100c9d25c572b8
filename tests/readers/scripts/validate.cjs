// validate.cjs PACKAGES FILE: the report of Khronos' glTF validator, as JSON.
const { readFileSync } = require('node:fs');
const path = require('node:path');

const [packages, file] = process.argv.slice(2);
const validator = require(path.resolve(packages, 'gltf-validator'));
const beside = (uri) => new Uint8Array(
  readFileSync(path.resolve(path.dirname(file), decodeURIComponent(uri))),
);
validator
  .validateBytes(new Uint8Array(readFileSync(file)), {
    uri: path.basename(file),
    maxIssues: 0,
    externalResourceFunction: async (uri) => beside(uri),
  })
  .then((report) => console.log(JSON.stringify(report.issues)));
