// Address options: ?camera=NAME starts there, ?bare leaves all controls away, ?webgl asks for it. The
// page for a client (scene.client) has the viewer's controls and no panel.
// For scripts: `splatReady` is a promise that resolves when the first camera is drawn, and
// `splatShow(name)` one that resolves when the camera of that name is; `splatSelection` what is
// selected.
// Sorting runs beside drawing and takes a few frames to be seen; every ten, the streamed levels are chosen again.
const STEADY_FRAMES = 12;
const FLIGHT_S = 10; // more than any flight of the viewer takes

const rgbOf = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);

function settingsFor(scene) {
    const pose = (shot) => {
        const half = Math.max(shot.width / shot.fx, shot.height / shot.fy) / 2;
        const fov = (Math.atan(half) * 360) / Math.PI;
        return { initial: { position: shot.position, target: shot.target, fov } };
    };
    const off = { enabled: false };
    return {
        version: 2,
        tonemapping: "none",
        highPrecisionRendering: false,
        background: { color: rgbOf(scene.background || "#000000") },
        postEffectSettings: {
            sharpness: { ...off, amount: 0 },
            bloom: { ...off, intensity: 1, blurLevel: 2 },
            grading: { ...off, brightness: 0, contrast: 1, saturation: 1, tint: [1, 1, 1] },
            vignette: { ...off, intensity: 0.5, inner: 0.3, outer: 0.75, curvature: 1 },
            fringing: { ...off, intensity: 0.5 }
        },
        animTracks: [],
        cameras: [pose(scene.shots[0])],
        annotations: scene.shots.map((shot) => ({
            position: shot.target,
            title: shot.name,
            text: "",
            camera: pose(shot)
        })),
        startMode: "default"
    };
}

function steady(app) {
    return new Promise((resolve) => {
        let drawn = 0;
        const draw = () => {
            app.renderNextFrame = true;
        };
        const ready = (camera, layer, complete, loading) => {
            drawn = complete && loading === 0 ? drawn + 1 : 0;
            if (drawn < STEADY_FRAMES) return;
            app.off("update", draw);
            app.systems.gsplat.off("frame:ready", ready);
            app.once("frameend", resolve);
        };
        app.on("update", draw);
        app.systems.gsplat.on("frame:ready", ready);
    });
}

function loaded(viewer) {
    return new Promise((resolve, reject) => {
        if (viewer.state.loaded) resolve();
        viewer.events.once("loaded:changed", resolve);
        viewer.app.assets.on("error", (error) => reject(new Error(String(error))));
        addEventListener("unhandledrejection", ({ reason }) => reject(reason)); // a download that ended
    });
}

// "Frame", by key or button: the first camera. The viewer's own goes back until it sees all splats,
// which is outside the room.
function frameBy(act) {
    const instead = (event) => {
        event.stopPropagation();
        act();
    };
    document.addEventListener("keydown", (event) => {
        const plain = !event.ctrlKey && !event.metaKey && !event.altKey;
        if (plain && event.key.toLowerCase() === "f" && !takesKey(event.target, "f")) instead(event);
    });
    for (const button of document.querySelectorAll(".sse-frame")) button.addEventListener("click", instead, true);
}

// Ends the viewer's flight to a camera: a touch would let go of the lens in the middle of it. Keys
// that are held would fly for as long.
function endFlight(viewer) {
    viewer.state.inputEnabled = false;
    viewer.app.fire("update", FLIGHT_S);
    viewer.state.inputEnabled = true;
}

// While points are named, a click does not turn the camera to what it hits, as it does in orbit mode.
function holdWhileNaming(events) {
    const { fire } = events;
    events.fire = function (name, ...rest) {
        const turns = name === "pick" || name === "orbitTarget:set";
        return turns && find("tool").value === "points" ? this : fire.call(this, name, ...rest);
    };
}

async function checkGraphics() {
    const context = document.createElement("canvas").getContext("webgl2");
    if (context) {
        context.getExtension("WEBGL_lose_context")?.loseContext(); // a page may have few of them
        return;
    }
    if (navigator.gpu && (await navigator.gpu.requestAdapter())) return;
    throw new Error(
        "this browser has neither WebGL 2 nor WebGPU, or they are switched off. Switch on hardware "
        + "acceleration in its settings, or take another browser."
    );
}

async function start() {
    const scene = JSON.parse(find("scene").textContent);
    const query = new URLSearchParams(location.search);
    const bare = query.has("bare");
    const withPanel = !bare && !scene.client;
    const streamed = scene.levels.length > 0; // then the viewer fetches what it wants of it
    if (scene.count === 0) throw new Error("there is not one splat to show.");
    await checkGraphics();
    const source = streamed ? null : await sourceOf(scene);
    const meta = streamed ? await (await fetched(scene.content)).json() : null;
    const viewer = await SuperSplatViewer.createViewer({
        container: find("view"),
        settings: settingsFor(scene),
        contentUrl: scene.content || "scene.ply",
        contentFilename: streamed ? "lod-meta.json" : "scene.ply",
        contents: streamed ? undefined : await source(),
        renderer: query.has("webgl") ? "webgl" : "webgpu",
        ui: !bare,
        aa: scene.antialias,
        noanim: true
    });
    const { app } = viewer;
    app.scene.gsplat.radialSorting = false; // by z, the order that the splats were trained in
    await loaded(viewer);
    let panel = null;
    const lens = new Lens(app, app.graphicsDevice.canvas, () => panel && panel.moved());
    viewer.events.on("cameraMode:changed", () => lens.release()); // by a button or a key
    // After the lens has placed the camera.
    if (streamed) window.splatLevels = new Levels(app, meta, scene.levels);
    const show = (shot) => {
        viewer.selectAnnotation(scene.shots.indexOf(shot)); // where orbiting goes on from
        endFlight(viewer);
        lens.hold(shot);
        if (panel) panel.shown(shot);
        return steady(app);
    };
    if (withPanel) panel = new Panel(scene, show);
    else shareKeys();
    if (withPanel) {
        window.splatSelection = new Selection(scene, app, source);
        holdWhileNaming(viewer.events);
    }
    if (!bare) makeAccessible(scene, app.graphicsDevice.canvas);
    app.on("prerender", () => panel && panel.frames++);
    const named = (name) => scene.shots.find((shot) => shot.name === name);
    window.splatShow = async (name) => {
        if (!named(name)) throw new Error(`There is no camera ${name}.`);
        await show(named(name));
        return { name, splats: app.stats.frame.gsplats, renderer: app.graphicsDevice.deviceType };
    };
    window.splatStarted = true;
    // An error of another script, an extension's say, may have been reported while the page loaded.
    document.body.classList.remove("failed");
    find("message").setAttribute("role", "status");
    find("message").hidden = true;
    const heldOut = scene.shots.find((shot) => shot.held_out);
    const first = named(query.get("camera")) || heldOut || scene.shots[0];
    frameBy(() => show(first));
    return window.splatShow(first.name);
}

window.splatReady = start();
window.splatReady.catch((error) => window.splatFailed(error.message));
