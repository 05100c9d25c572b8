// The exact lens and place of a shot over the viewer's own camera, which knows neither roll nor an
// off-centre principal point. The place is held until the visitor moves; the lens stays, so that
// the picture does not jump at the first touch.
const NEAR = 1e-3; // of the distance of what a photograph shows
const FAR = 1e7;

function frustumOf(shot, width, height, near) {
    // The whole picture fits into the canvas, centred, as `object-fit: contain` shows a photograph.
    const scale = Math.min(width / shot.width, height / shot.height);
    const fx = shot.fx * scale;
    const fy = shot.fy * scale;
    const cx = width / 2 + (shot.cx - shot.width / 2) * scale;
    const cy = height / 2 + (shot.cy - shot.height / 2) * scale;
    return [
        (-near * cx) / fx,
        (near * (width - cx)) / fx,
        (-near * (height - cy)) / fy,
        (near * cy) / fy
    ];
}

// The projection of the viewer's camera, with the lens of a shot if one is held.
function projectionOf(camera) {
    const matrix = camera.projectionMatrix.clone();
    if (camera.calculateProjection) camera.calculateProjection(matrix);
    return matrix;
}

class Lens {
    constructor(app, canvas, moved) {
        this.app = app;
        this.shot = null;
        this.entity = app.root.findByName("camera");
        this.moved = moved;
        const release = () => this.release();
        canvas.addEventListener("pointerdown", release, { capture: true });
        canvas.addEventListener("wheel", release, { capture: true, passive: true });
        window.addEventListener("keydown", (event) => {
            if (/^([wasdqe]|arrow\w+|[1-3]|[fr])$/i.test(event.key)) release();
        });
        // After the viewer's own handler, which was there first, has placed its camera.
        app.on("update", () => this.place());
    }

    hold(shot) {
        this.shot = shot;
        this.depth = Math.hypot(...shot.target.map((value, i) => value - shot.position[i]));
        const { camera } = this.entity;
        camera.calculateProjection = (matrix) => {
            const { width, height } = this.app.graphicsDevice;
            const edges = frustumOf(shot, width, height, camera.nearClip);
            matrix.setFrustum(...edges, camera.nearClip, camera.farClip);
        };
        this.app.renderNextFrame = true;
    }

    release() {
        if (!this.shot) return;
        this.shot = null;
        this.app.renderNextFrame = true;
        this.moved();
    }

    place() {
        if (!this.shot) return;
        this.entity.setPosition(...this.shot.position);
        this.entity.setRotation(...this.shot.rotation);
        this.entity.camera.nearClip = NEAR * this.depth;
        this.entity.camera.farClip = FAR * this.depth;
    }
}
