// Selecting by eye: a box in the scene, or what a lasso surrounds on the screen, written as the
// operations of `splat edit` that select the same splats, to the last one. Numbers are rounded
// before they are used, and added and multiplied in the order in which Python does it.
const CORNER_PX = 4; // between neighbouring corners of a lasso, at least
const DOTS = 200000; // of what is selected, at most
const ENDS = ["x from", "y from", "z from", "x to", "y to", "z to"];
const REACH_PX = [4, 8, 16, 32]; // around a click, until what lies there covers what is behind it
const EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

const rounded = (value) => Number(value.toPrecision(9));

function boxOf(ends) {
    const [x0, y0, z0, x1, y1, z1] = ends;
    return {
        ends,
        text: `box:${ends.join(",")}`,
        holds: (x, y, z) => x >= x0 && x <= x1 && y >= y0 && y <= y1 && z >= z0 && z <= z1
    };
}

// view [12]: three rows that take a point (x, y, z, 1) to pixels times depth, and depth.
function seenBy(view, x, y, z) {
    const row = (i) => view[i] * x + view[i + 1] * y + view[i + 2] * z + view[i + 3];
    const depth = row(8);
    return depth > 0 ? [row(0) / depth, row(4) / depth] : null;
}

function lassoOf(view, corners) {
    const holds = (x, y, z) => {
        const at = seenBy(view, x, y, z);
        let inside = false;
        for (let i = 0, j = corners.length - 1; at && i < corners.length; j = i++) {
            const [[ax, ay], [bx, by]] = [corners[i], corners[j]];
            if (ay > at[1] === by > at[1]) continue;
            if (at[0] < ((bx - ax) * (at[1] - ay)) / (by - ay) + ax) inside = !inside;
        }
        return inside;
    };
    return { text: `lasso:${[...view, ...corners.flat()].join(",")}`, holds };
}

// Of a float of 16 bits from 0 to 1.
const fromHalf = (bits) => 2 ** ((bits >> 10) - 15) * (1 + (bits & 1023) / 1024);

// The box around points.
function boxAround(points) {
    const ends = (choose) => [0, 1, 2].map((axis) => choose(...points.map((at) => at[axis])));
    return boxOf([...ends(Math.min), ...ends(Math.max)]);
}

function viewOf(app) {
    const { camera } = app.root.findByName("camera");
    const model = app.root.findByName("gsplat").getWorldTransform();
    const m = projectionOf(camera).mul(camera.viewMatrix).mul(model).data;
    const { clientWidth: width, clientHeight: height } = app.graphicsDevice.canvas;
    const row = (of) => [0, 4, 8, 12].map((i) => rounded(of(m[i], m[i + 1], m[i + 3])));
    return [
        ...row((x, _, w) => (width / 2) * (w + x)),
        ...row((_, y, w) => (height / 2) * (w - y)),
        ...row((x, y, w) => w)
    ];
}

// [N * 3] of the splats, null where they stream: then only what is near has come.
function centresOf(app) {
    const { resource } = app.root.findByName("gsplat").gsplat;
    if (resource.octree) return null;
    return resource.centers || resource.gsplatData.getCenters();
}

// A word for the shell of this system: in Windows' shells double quotes hold a name, elsewhere single.
function quoted(word) {
    if (/^[\w@%+=:./-]+$/.test(word)) return word;
    return /^Win/.test(navigator.platform) ? `"${word}"` : `'${word.replaceAll("'", "'\\''")}'`;
}

// The opacities that the viewer draws: those of splats that are left out become 0.
class Colours {
    constructor(app) {
        this.component = app.root.findByName("gsplat").gsplat;
        this.texture = this.component.resource.streams.getTexture("splatColor");
        this.alphas = this.texture.lock().filter((_, i) => i % 4 === 3);
        this.texture.unlock();
        this.hidden = new Set();
        this.changed = false;
    }

    show(index, stays) {
        if (this.hidden.has(index) !== stays) return;
        this.changed = true;
        if (stays) this.hidden.delete(index);
        else this.hidden.add(index);
    }

    apply() {
        if (!this.changed) return;
        this.changed = false;
        const pixels = this.texture.lock();
        for (let i = 0; i < this.alphas.length; i++) {
            pixels[4 * i + 3] = this.hidden.has(i) ? 0 : this.alphas[i];
        }
        this.texture.unlock();
        this.component.workBufferUpdate = 1; // once
    }
}

class Selection {
    // source: () => a response with the .ply of the splats; null where they stream.
    constructor(scene, app, source) {
        this.scene = scene;
        this.app = app;
        this.source = source;
        this.centres = centresOf(app);
        this.colours = this.centres && new Colours(app);
        this.chain = [];
        this.region = null;
        this.corners = [];
        this.points = [];
        const { min, max } = scene.bounds;
        const size = Math.max(...max.map((end, axis) => end - min[axis])) || 1;
        this.digits = Math.min(Math.max(4 - Math.floor(Math.log10(size)), 0), 20); // of coordinates
        if (!this.centres) find("tool").querySelector("option:last-child").remove();
        this.canvas = find("view").appendChild(document.createElement("canvas"));
        this.canvas.id = "overlay";
        this.canvas.onpointerdown = (event) => this.begin(event);
        this.canvas.onpointermove = (event) => event.buttons && this.draw(event);
        this.canvas.onpointerup = () => this.end();
        this.listen(app.graphicsDevice.canvas);
        find("tool").onchange = () => this.choose();
        find("keep").onclick = () => this.add("crop");
        find("drop").onclick = () => this.add("drop");
        find("undo").onclick = () => this.undo();
        find("save").onclick = () => this.save();
        find("save").hidden = !source;
        find("copy").onclick = () => {
            find("chain").select();
            document.execCommand("copy"); // the newer way is not there for a page from disk
        };
        this.makeSliders();
        app.on("frameend", () => this.paint());
        find("select").hidden = false;
        this.update();
    }

    // A click on the scene, which is no drag, is a point.
    listen(canvas) {
        let pressed = [0, 0];
        const listener = ({ type, offsetX, offsetY }) => {
            if (type === "pointerdown") pressed = [offsetX, offsetY];
            else if (Math.hypot(offsetX - pressed[0], offsetY - pressed[1]) < CORNER_PX) {
                if (find("tool").value === "points") this.point(offsetX, offsetY);
            }
        };
        for (const type of ["pointerdown", "pointerup"]) canvas.addEventListener(type, listener, true);
    }

    makeSliders() {
        const { min, max } = this.scene.bounds;
        this.sliders = ENDS.map((label, i) => {
            const [low, high] = [min[i % 3], max[i % 3]];
            const slider = document.createElement("input");
            const all = { type: "range", min: low, max: high, step: "any", value: i < 3 ? low : high };
            Object.assign(slider, all, { title: label, oninput: () => this.choose() });
            return find("box").appendChild(slider);
        });
    }

    choose() {
        const tool = find("tool").value;
        find("box").hidden = tool !== "box";
        this.canvas.style.pointerEvents = tool === "lasso" ? "auto" : "none";
        this.corners = [];
        this.points = [];
        this.region = tool === "box" ? boxOf(this.ends()) : null;
        this.update();
    }

    ends() {
        const ends = this.sliders.map((slider) => rounded(slider.valueAsNumber));
        return [...ends.slice(0, 3), ...ends.slice(3).map((end, i) => Math.max(end, ends[i]))];
    }

    begin(event) {
        this.canvas.setPointerCapture(event.pointerId);
        this.corners = [];
        this.draw(event);
    }

    draw({ offsetX, offsetY }) {
        const last = this.corners.at(-1);
        if (last && Math.hypot(offsetX - last[0], offsetY - last[1]) < CORNER_PX) return;
        this.corners.push([rounded(offsetX), rounded(offsetY)]);
        this.app.renderNextFrame = true;
    }

    end() {
        this.region = this.corners.length > 2 ? lassoOf(viewOf(this.app), this.corners) : null;
        this.corners = [];
        this.update();
    }

    // Name the place of the scene at a pixel; two and more make a box.
    point(x, y) {
        const at = this.placeAt(x, y);
        if (!at) return;
        this.points.push(at);
        this.region = this.points.length > 1 ? boxAround(this.points) : null;
        this.update();
        const box = this.region ? `&box=${this.region.ends}` : "";
        if (this.scene.content) fetch(`point?at=${at}${box}`); // `splat view` prints it
    }

    // The splat that covers half of what is behind it, from there.
    placeAt(x, y) {
        const view = viewOf(this.app);
        for (const reach of REACH_PX) {
            const near = [];
            for (let i = 0; i < this.centres.length; i += 3) {
                const at = this.centres.subarray(i, i + 3);
                const pixel = seenBy(view, ...at);
                if (!pixel || Math.hypot(pixel[0] - x, pixel[1] - y) > reach) continue;
                if (this.left(...at)) near.push([view[8] * at[0] + view[9] * at[1] + view[10] * at[2], i]);
            }
            let behind = 1;
            for (const [, i] of near.sort((a, b) => a[0] - b[0])) {
                behind *= 1 - fromHalf(this.colours.alphas[i / 3]);
                if (behind < 0.5) return [...this.centres.subarray(i, i + 3)].map((v) => Number(v.toFixed(this.digits)));
            }
        }
        return null;
    }

    add(word) {
        if (!this.region) return;
        this.chain.push({ word, region: this.region });
        find("tool").value = "";
        this.choose();
    }

    undo() {
        this.chain.pop();
        this.update();
    }

    left(x, y, z) {
        return this.chain.every(({ word, region }) => region.holds(x, y, z) === (word === "crop"));
    }

    update() {
        this.chosen = [];
        let left = 0;
        const at = this.centres || [];
        for (let i = 0; i < at.length; i += 3) {
            const stays = this.left(at[i], at[i + 1], at[i + 2]);
            this.colours.show(i / 3, stays);
            if (!stays) continue;
            left++;
            if (this.region && this.region.holds(at[i], at[i + 1], at[i + 2])) this.chosen.push(i);
        }
        const count = (n) => n.toLocaleString("en");
        const summary = this.region ? `${count(this.chosen.length)} of ${count(left)} selected` : `${count(left)} left`;
        const last = this.points.length ? `${this.points.at(-1).join(",")}: ` : "";
        find("chosen").textContent = this.centres ? last + summary : "";
        const some = this.region && (this.chosen.length || !this.centres);
        for (const name of ["keep", "drop"]) find(name).disabled = !some;
        for (const name of ["undo", "save", "copy"]) find(name).disabled = !this.chain.length;
        if (this.centres && !left) find("save").disabled = true;
        const words = this.chain.map(({ word, region }) => `--${word} "${region.text}"`);
        find("chain").value = [`splat edit ${quoted(this.scene.source)} edited.ply`, ...words].join(" ");
        if (this.colours) this.colours.apply();
        this.app.renderNextFrame = true;
    }

    async save() {
        try {
            const bytes = new Uint8Array(await (await this.source()).arrayBuffer());
            const link = document.createElement("a");
            link.href = URL.createObjectURL(filtered(bytes, (x, y, z) => this.left(x, y, z)));
            link.download = "edited.ply";
            link.click();
            setTimeout(() => URL.revokeObjectURL(link.href), 60000);
        } catch (error) {
            find("chosen").textContent = `Not saved: ${error.message}`;
        }
    }

    paint() {
        const { canvas } = this;
        const { clientWidth: width, clientHeight: height } = this.app.graphicsDevice.canvas;
        if (canvas.width !== width) canvas.width = width;
        if (canvas.height !== height) canvas.height = height;
        const pen = canvas.getContext("2d");
        pen.clearRect(0, 0, width, height);
        const nothing = !this.region && !this.corners.length && !this.points.length;
        canvas.style.opacity = nothing ? 0 : 1; // Chromium may go on showing what was cleared
        if (nothing) return;
        const view = viewOf(this.app);
        pen.fillStyle = pen.strokeStyle = "#fc0";
        const step = Math.ceil(this.chosen.length / DOTS) || 1;
        for (let i = 0; i < this.chosen.length; i += step) {
            const at = seenBy(view, ...this.centres.subarray(this.chosen[i], this.chosen[i] + 3));
            if (at) pen.fillRect(at[0] - 1, at[1] - 1, 2, 2);
        }
        this.paintLines(pen, [...this.corners.map((to, i) => [this.corners.at(i - 1), to])]);
        for (const at of this.points.map((point) => seenBy(view, ...point))) {
            if (at) pen.fillRect(at[0] - 3, at[1] - 3, 7, 7);
        }
        if (this.region && this.region.ends) this.paintLines(pen, this.edges(view, this.region.ends));
    }

    edges(view, ends) {
        const corner = (i) => seenBy(view, ends[i & 1 ? 3 : 0], ends[i & 2 ? 4 : 1], ends[i & 4 ? 5 : 2]);
        return EDGES.map((pair) => pair.map(corner)).filter(([a, b]) => a && b);
    }

    paintLines(pen, lines) {
        pen.beginPath();
        for (const [from, to] of lines) {
            pen.moveTo(...from);
            pen.lineTo(...to);
        }
        pen.stroke();
    }
}
