// Pictures come from the trainer, one request at a time: at once while the visitor moves, seldom
// while everything rests, never while the page is hidden. For scripts: `splatLive` tells what is
// shown.
const STATE_MS = 500;
const REST_SHARE = 0.05; // of the trainer's time, at most, for a picture that only rests
const REST_MS = 1000;
const QUICK_SIDE = 480;
const SIDES = [64, 1280];
const TURN = 0.006; // radians a pixel
const STEP = 0.05; // of the distance, a key press
const MOVES = {
    w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0]
};

const scene = JSON.parse(find("scene").textContent);
const image = find("view").appendChild(new Image());
const orbit = new Orbit();
const live = { state: {}, picture: null, shot: scene.shots[0], version: 0, drawn: -1, gone: false };
window.splatLive = live;
let wake = () => {};

const pause = (ms) =>
    new Promise((done) => {
        wake = done;
        setTimeout(done, ms);
    });

function duration(seconds) {
    const rest = Math.round(seconds);
    const parts = [Math.floor(rest / 3600), Math.floor(rest / 60) % 60, rest % 60];
    if (!parts[0]) parts.shift();
    return parts.map((part, i) => String(part).padStart(i ? 2 : 1, "0")).join(":");
}

class Live extends Panel {
    tick() {
        const { state } = live;
        const { splats, loss, held_out_psnr_db: psnr } = state.numbers || {};
        const grouped = (value) => value.toLocaleString("en");
        const lines = [];
        if (state.total) lines.push(`Step ${grouped(state.done)} of ${grouped(state.total)}`);
        if (splats !== undefined) lines.push(`${grouped(splats)} splats, loss ${loss}`);
        if (psnr !== undefined) lines.push(`Held-out photographs: PSNR ${psnr} dB`);
        if (state.spent_s) {
            const left = state.left_s && !state.end ? `, ${duration(state.left_s)} left` : "";
            lines.push(`${duration(state.spent_s)} so far${left}`);
            lines.push(`Drawing takes ${(100 * state.drawing_share).toFixed(1)} % of the time`);
        }
        find("figures").textContent = lines.join("\n");
        const ends = {
            finished: "Training has finished. `splat view` shows the result.",
            stopped: "Training was stopped. The same command goes on with it."
        };
        const gone = live.gone ? "The command has ended. `splat status` says how far it came." : "";
        const waiting = live.picture ? "" : `${state.phase || "Starting"}\u2026`;
        find("message").textContent = ends[state.end] || gone || waiting;
        find("message").hidden = !find("message").textContent;
    }
}

async function ask(address) {
    const answer = await fetch(address);
    if (!answer.ok) throw new Error(`${address}: ${answer.status}`);
    return answer.json();
}

const over = () => Boolean(live.state.end) || live.gone;

async function follow() {
    while (!over()) {
        try {
            live.state = await ask("state");
        } catch {
            live.gone = true;
        }
        panel.tick();
        if (over()) wake();
        await new Promise((done) => setTimeout(done, STATE_MS));
    }
}

async function draw() {
    const { version } = live;
    const box = find("view").getBoundingClientRect();
    const whole = Math.max(SIDES[0], Math.min(SIDES[1], Math.round(Math.max(box.width, box.height))));
    const still = live.drawn === version || !live.picture;
    const side = still ? whole : Math.min(whole, QUICK_SIDE);
    const place = live.moved ? orbit.place() : live.shot.place;
    const shot = scene.shots.indexOf(live.shot);
    const picture = await ask(`picture?shot=${shot}&side=${side}&place=${place.join()}`);
    if (!picture.jpeg) return REST_MS;
    live.drawn = version;
    image.src = picture.jpeg;
    await image.decode();
    live.picture = { step: picture.step, seconds: picture.seconds, sharp: still, place, version };
    panel.tick();
    if (version !== live.version || !still) return 0;
    return Math.max(REST_MS, (1000 * picture.seconds) / REST_SHARE);
}

async function pictures() {
    while (!over()) {
        const wanted = live.state.phase === "training" && !document.hidden;
        const rest = wanted ? await draw().catch(() => REST_MS) : STATE_MS;
        if (!over()) await pause(rest);
    }
    await draw().catch(() => {}); // the trainer's last picture stays
}

function changed() {
    live.version++;
    wake();
}

function moved() {
    if (!live.moved) panel.moved();
    live.moved = true;
    changed();
}

// One finger, or the mouse, turns or moves; a second one zooms, and both move what is between them.
function dragged([x, y], event, other) {
    const box = image.getBoundingClientRect();
    const { width, height, fx } = live.shot;
    const pixel = 1 / (fx * Math.min(box.width / width, box.height / height));
    const [right, down] = [event.clientX - x, event.clientY - y];
    if (other) {
        const before = Math.hypot(x - other[0], y - other[1]);
        const after = Math.hypot(event.clientX - other[0], event.clientY - other[1]);
        orbit.shift((-right * pixel) / 2, (-down * pixel) / 2, 0); // the other finger moves the rest
        orbit.zoom(Math.max(1, before) / Math.max(1, after));
    } else if (event.buttons & 1 && !event.shiftKey) orbit.turn(-right * TURN, -down * TURN);
    else orbit.shift(-right * pixel, -down * pixel, 0);
}

function listen() {
    const fingers = new Map(); // where each pointer was last; a third one does nothing
    image.draggable = false;
    image.onpointerdown = (event) => {
        if (fingers.size < 2) fingers.set(event.pointerId, [event.clientX, event.clientY]);
        image.setPointerCapture(event.pointerId);
    };
    image.onpointerup = image.onpointercancel = (event) => fingers.delete(event.pointerId);
    image.oncontextmenu = (event) => event.preventDefault();
    image.onpointermove = (event) => {
        const from = fingers.get(event.pointerId);
        if (!from) return;
        const other = [...fingers].find(([pointer]) => pointer !== event.pointerId);
        dragged(from, event, other && other[1]);
        fingers.set(event.pointerId, [event.clientX, event.clientY]);
        moved();
    };
    image.addEventListener("wheel", (event) => {
        event.preventDefault();
        orbit.zoom(Math.exp(Math.max(-50, Math.min(50, event.deltaY)) * 0.004));
        moved();
    }, { passive: false });
    window.addEventListener("keydown", (event) => {
        if (event.ctrlKey || event.metaKey || event.altKey) return;
        const way = MOVES[event.key.toLowerCase()];
        if (way) {
            orbit.shift(...way.map((part) => part * STEP));
            moved();
        }
    });
    document.addEventListener("visibilitychange", () => wake());
    window.addEventListener("resize", changed);
}

const panel = new Live(scene, (shot) => {
    live.shot = shot;
    live.moved = false;
    orbit.start(shot);
    changed();
    panel.shown(shot);
});
find("keys").textContent =
    `Drag turns, right drag moves, the wheel comes closer, W A S D Q E fly. ${find("keys").textContent}`;
panel.step(Math.max(0, scene.shots.findIndex((shot) => shot.held_out)));
listen();
follow();
pictures();
window.splatReady = window.splatStarted = true;
