// unpack.mjs PACKAGES FOLDER: the browser of @sparticuz/chromium and the libraries that a bare
// machine lacks, unpacked into FOLDER.
import { pathToFileURL } from 'node:url';

const [packages, folder] = process.argv.slice(2);
process.env.TMPDIR = folder; // where the package unpacks to
const home = `${packages}/@sparticuz/chromium`;
const load = (name) => import(pathToFileURL(`${home}/build/${name}.js`).href);
const { default: chromium } = await load('index');
const { inflate } = await load('lambdafs');
await inflate(`${home}/bin/al2023.tar.br`);
console.log(await chromium.executablePath());
