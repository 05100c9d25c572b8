// Figures, the list of cameras, and the photograph beside the picture.
const find = (id) => document.getElementById(id);

class Panel {
    constructor(scene, show) {
        this.scene = scene;
        this.show = show;
        this.frames = 0;
        find("title").textContent = scene.title;
        for (const shot of scene.shots) {
            const text = shot.name + (shot.held_out ? " (held out)" : "");
            find("shot").add(new Option(text, shot.name));
        }
        find("shot").onchange = () => show(scene.shots[find("shot").selectedIndex]);
        find("previous").onclick = () => this.step(-1);
        find("next").onclick = () => this.step(1);
        find("back").onclick = () => this.step(0);
        this.box = find("compare").querySelector("input");
        this.box.onchange = () => this.step(0);
        find("previous").hidden = find("next").hidden = scene.shots.length < 2;
        find("compare").hidden = !scene.shots.some((shot) => shot.photo);
        // A list or button that keeps the focus would take the keys that fly.
        find("panel").addEventListener("change", () => document.activeElement.blur());
        for (const button of find("panel").querySelectorAll("button")) {
            button.addEventListener("click", () => button.blur());
        }
        setInterval(() => this.tick(), 1000);
        this.tick();
        find("panel").hidden = false;
    }

    step(by) {
        const count = this.scene.shots.length;
        this.show(this.scene.shots[(find("shot").selectedIndex + by + count) % count]);
    }

    shown(shot) {
        find("shot").value = shot.name;
        const beside = this.box.checked && shot.photo !== "";
        find("photo").hidden = !beside;
        find("stage").classList.toggle("beside", beside);
        if (beside) find("photo").querySelector("img").src = shot.photo;
        const role = shot.held_out ? "training never saw it" : "used in training";
        find("photo").querySelector("figcaption").textContent = `${shot.name}: ${role}`;
        find("note").textContent = "";
    }

    moved() {
        find("note").textContent = "Moved away from the camera.";
    }

    // The viewer draws only when something changes: no frames is no fault.
    tick() {
        const rate = this.frames ? `${this.frames} frames/s` : "at rest";
        find("figures").textContent = `${this.scene.count.toLocaleString("en")} splats, ${rate}`;
        this.frames = 0;
    }
}
