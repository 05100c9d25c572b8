// The splat budget of a streamed asset: for each leaf, the coarsest level whose splats are at most a
// pixel wide at its distance. The viewer distributes the sum over the leaves.
const BUDGET_DIGITS = 2; // a budget that changes with every step would cause loading and sorting each time

function leavesOf(tree) {
    const found = [];
    const waiting = [tree];
    while (waiting.length) {
        const node = waiting.pop();
        if (node.lods) found.push(node);
        waiting.push(...(node.children || []));
    }
    return found;
}

class Levels {
    // sizes: width of the splats of each level, finest first, in world units
    constructor(app, meta, sizes) {
        this.app = app;
        this.sizes = sizes;
        this.leaves = leavesOf(meta.tree).map((leaf) => ({
            bound: leaf.bound,
            counts: sizes.map((_, level) => (leaf.lods[level] ? leaf.lods[level].count : 0))
        }));
        this.most = this.budget = app.scene.gsplat.splatBudget;
        app.on("update", () => this.choose());
    }

    splatsAt(place, pixels) {
        let sum = 0;
        for (const { bound, counts } of this.leaves) {
            const away = place.map((v, i) => Math.max(bound.min[i] - v, v - bound.max[i], 0));
            const pixel = Math.hypot(...away) / pixels;
            let level = this.sizes.findLastIndex((size) => size <= pixel);
            while (level > 0 && !counts[level]) level--;
            sum += counts[Math.max(level, 0)];
        }
        return sum;
    }

    choose() {
        const { gsplat } = this.app.scene;
        if (gsplat.splatBudget !== this.budget) this.most = gsplat.splatBudget; // set by the visitor
        const { camera } = this.app.root.findByName("camera");
        const model = this.app.root.findByName("gsplat").getWorldTransform().clone().invert();
        const place = model.transformPoint(camera.entity.getPosition());
        const pixels = (projectionOf(camera).data[5] * this.app.graphicsDevice.height) / 2;
        const sum = this.splatsAt([place.x, place.y, place.z], pixels);
        const whole = this.leaves.reduce((all, { counts }) => all + counts[0], 0);
        const digits = 10 ** Math.max(0, Math.ceil(Math.log10(sum + 1)) - BUDGET_DIGITS);
        const some = sum < whole ? Math.ceil(sum / digits) * digits : this.most;
        this.budget = Math.max(1, Math.min(this.most, some));
        if (gsplat.splatBudget !== this.budget) gsplat.splatBudget = this.budget;
    }
}
