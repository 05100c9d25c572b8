import * as THREE from 'three';
import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';

let renderer;
let scene;
let camera;

export async function open(canvas, address) {
  renderer?.dispose();
  THREE.ColorManagement.enabled = false;
  renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  renderer.setSize(canvas.width, canvas.height);
  scene = new THREE.Scene();
  // What the reference rasteriser does, where Spark has other defaults: widen each splat by 0.3
  // pixels without making up for it, sort by depth, cut at 3 standard deviations.
  const spark = new SparkRenderer({
    renderer, preBlurAmount: 0.3, blurAmount: 0, sortRadial: false, maxStdDev: 3, clipXY: 4,
  });
  scene.add(spark);
  camera = new THREE.PerspectiveCamera();
  camera.near = 0.01;
  camera.far = 1000;
  scene.add(camera);
  const mesh = new SplatMesh({ url: address });
  scene.add(mesh);
  await mesh.initialized;
  renderer.setAnimationLoop(() => renderer.render(scene, camera));
  return mesh.splats?.getNumSplats?.() ?? mesh.packedSplats.numSplats;
}

export function look({ worldFromView, projection }) {
  camera.matrixAutoUpdate = false;
  camera.matrix.fromArray(worldFromView);
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}
