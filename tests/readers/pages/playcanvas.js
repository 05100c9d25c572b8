import * as pc from 'playcanvas';

let app;
let camera;

export async function open(canvas, address) {
  app?.destroy();
  app = new pc.Application(canvas, {
    graphicsDeviceOptions: { antialias: false, alpha: false, preserveDrawingBuffer: true },
  });
  app.setCanvasResolution(pc.RESOLUTION_FIXED, canvas.width, canvas.height);
  app.setCanvasFillMode(pc.FILLMODE_NONE);
  app.scene.gsplat.dataFormat = pc.GSPLATDATA_LARGE; // float32 colours and positions
  // By default colours follow the view only after a turn of 10 degrees.
  app.scene.gsplat.colorUpdateAngle = 0;
  camera = new pc.Entity();
  camera.addComponent('camera', {
    clearColor: new pc.Color(0, 0, 0, 1),
    nearClip: 0.01,
    farClip: 1000,
    toneMapping: pc.TONEMAP_NONE,
  });
  app.root.addChild(camera);
  app.start();
  const name = address.split('/').pop();
  const kind = /\.gl(b|tf)$/.test(name) ? 'container' : 'gsplat';
  const asset = new pc.Asset(name, kind, { url: address, filename: name });
  await new Promise((done, failed) => {
    asset.once('load', done);
    asset.once('error', (message) => failed(new Error(message)));
    app.assets.add(asset);
    app.assets.load(asset);
  });
  const resources = kind === 'container' ? scene(asset.resource) : [component({ asset })];
  return resources.reduce((sum, one) => sum + one.numSplats, 0);
}

function scene(container) {
  const root = container.instantiateRenderEntity();
  app.root.addChild(root);
  return root.findComponents('gsplat').map((found) => found.resource ?? found.asset);
}

function component(options) {
  const entity = new pc.Entity();
  entity.addComponent('gsplat', options);
  app.root.addChild(entity);
  return options.asset.resource;
}

export async function look({ worldFromView, projection }) {
  const place = new pc.Mat4();
  place.data.set(worldFromView);
  camera.camera.calculateProjection = (matrix) => matrix.data.set(projection);
  // Arrive by moving, as a person would: what is sorted and coloured before the first frame of a
  // new scene is done again only when the camera moves.
  for (const degrees of [2, 1, 0]) {
    camera.setPosition(place.getTranslation());
    camera.setRotation(new pc.Quat().setFromMat4(place));
    camera.rotateLocal(0, degrees, 0);
    camera.translateLocal(0.01 * degrees, 0, 0);
    await window.splatFrames(3);
  }
}
