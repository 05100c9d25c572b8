// Figures, the list of cameras, and the photograph beside the picture.
const find = (id) => document.getElementById(id);
const SMALL = "(pointer: coarse), (max-width: 700px)"; // as in page.css: a phone

// What has the keys: a list takes all but Escape, a button those that press it.
function takesKey(element, key) {
    if (!(element instanceof Element)) return false;
    if (element.matches("select, input, textarea")) return key !== "Escape";
    return element.matches("button, summary, [role=button]") && (key === " " || key === "Enter");
}

function shareKeys() {
    document.addEventListener("keydown", (event) => {
        if (takesKey(event.target, event.key)) event.stopPropagation(); // the viewer listens on the window
        else if (event.key === "Escape") document.activeElement.blur();
    });
}

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
        this.fold(matchMedia(SMALL).matches);
        find("fold").onclick = () => this.fold(!find("controls").hidden);
        // What keeps the focus after a click would take the keys that fly; a keyboard's focus stays.
        for (const kind of ["change", "click"]) {
            find("panel").addEventListener(kind, () => {
                if (!document.activeElement.matches(":focus-visible")) document.activeElement.blur();
            });
        }
        this.listen();
        setInterval(() => this.tick(), 1000);
        this.tick();
        find("panel").hidden = false;
    }

    fold(away) {
        find("controls").hidden = away;
        find("fold").setAttribute("aria-expanded", String(!away));
    }

    // The same keys on every page.
    listen() {
        shareKeys();
        const keys = {
            ",": () => this.step(-1),
            ".": () => this.step(1),
            b: () => this.step(0),
            p: () => find("compare").hidden || this.box.click()
        };
        window.addEventListener("keydown", (event) => {
            if (event.ctrlKey || event.metaKey || event.altKey) return;
            const act = keys[event.key.toLowerCase()];
            if (act) act();
        });
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
        const image = find("photo").querySelector("img");
        if (beside) Object.assign(image, { src: shot.photo, alt: `Photograph ${shot.name}` });
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
