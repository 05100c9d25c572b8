import * as THREE from 'three/webgpu';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { GLTFGaussianSplatLoaderExtension } from
  'three/addons/loaders/GLTFGaussianSplatLoaderExtension.js';

let renderer;
let camera;

export async function open(canvas, address) {
  renderer?.setAnimationLoop(null);
  renderer?.dispose();
  renderer = new THREE.WebGPURenderer({ canvas, antialias: false, forceWebGL: true });
  renderer.setSize(canvas.width, canvas.height);
  // The add-on's colours are display values already; three would encode them once more.
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  await renderer.init();
  const scene = new THREE.Scene();
  scene.background = new THREE.Color(0, 0, 0);
  camera = new THREE.PerspectiveCamera();
  camera.near = 0.01;
  camera.far = 1000;
  camera.matrixAutoUpdate = false;
  scene.add(camera);
  const loader = new GLTFLoader();
  loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const { scene: loaded } = await loader.loadAsync(address);
  scene.add(loaded);
  renderer.setAnimationLoop(() => renderer.render(scene, camera));
  let count = 0;
  loaded.traverse((one) => { if (one.isGaussianSplat) count += one.splatGeometry.getAttribute('position').count; });
  return count;
}

export function look({ worldFromView, projection }) {
  camera.matrix.fromArray(worldFromView);
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}
