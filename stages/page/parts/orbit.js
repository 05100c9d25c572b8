// A place to look from, moved by hand. Vectors are in the splats' world, where up is -y; the rows of
// `axes` are the camera's right, down and forward.
const UP = [0, -1, 0];
const STEEPEST = 0.995; // cosine between looking direction and up at which tilting ends
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const along = (point, direction, length) => point.map((value, i) => value + direction[i] * length);

// By Rodrigues' formula.
function rotated(v, axis, angle) {
    const [s, c] = [Math.sin(angle), Math.cos(angle)];
    const cross = [
        axis[1] * v[2] - axis[2] * v[1],
        axis[2] * v[0] - axis[0] * v[2],
        axis[0] * v[1] - axis[1] * v[0]
    ];
    return v.map((value, i) => value * c + cross[i] * s + axis[i] * dot(axis, v) * (1 - c));
}

class Orbit {
    start(shot) {
        const rows = [0, 4, 8].map((i) => shot.place.slice(i, i + 4));
        this.axes = rows.map((row) => row.slice(0, 3));
        this.centre = [0, 0, 0];
        rows.forEach((row, i) => (this.centre = along(this.centre, this.axes[i], -row[3])));
        this.distance = shot.depth;
        this.centre = along(this.centre, this.axes[2], this.distance);
    }

    // Around the point in front, by radians.
    turn(sideways, upwards) {
        const right = this.axes[0];
        const tilted = this.axes.map((axis) => rotated(axis, right, upwards));
        const steep = Math.abs(dot(tilted[2], UP));
        const before = Math.abs(dot(this.axes[2], UP));
        if (steep < STEEPEST || steep < before) this.axes = tilted;
        this.axes = this.axes.map((axis) => rotated(axis, UP, sideways));
    }

    zoom(factor) {
        this.distance *= factor;
    }

    // By parts of the distance, along the camera's own axes.
    shift(right, down, forward) {
        [right, down, forward].forEach((part, i) => {
            this.centre = along(this.centre, this.axes[i], part * this.distance);
        });
    }

    // The upper rows of world_to_camera.
    place() {
        const eye = along(this.centre, this.axes[2], -this.distance);
        return this.axes.flatMap((axis) => [...axis, -dot(axis, eye)]);
    }
}
