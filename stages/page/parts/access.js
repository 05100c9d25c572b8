// Names for screen readers, and the keyboard, for the viewer's own controls, which are not ours to edit.
const NAMES = {
    play: "Play", pause: "Pause", orbitCamera: "Orbit", flyCamera: "Fly", fpsCamera: "Walk",
    settings: "Settings", controlsButton: "Show or hide how to move", info: "About the viewer",
    arMode: "Augmented reality", vrMode: "Virtual reality", enterFullscreen: "Full screen",
    exitFullscreen: "Leave full screen", controlsHintClose: "Close", infoClose: "Close"
};

function makeAccessible(scene, canvas) {
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${scene.title}: a scene in three dimensions`);
    for (const [name, text] of Object.entries(NAMES)) {
        for (const button of document.querySelectorAll(`.sse-${name}`)) button.setAttribute("aria-label", text);
    }
    for (const row of document.querySelectorAll(".sse-settingsRow:not(:has(button))")) {
        row.tabIndex = 0;
        row.setAttribute("role", "button");
        row.addEventListener("keydown", (event) => {
            if (event.key === " " || event.key === "Enter") row.click();
        });
    }
    // How to move covers most of a small picture; its button shows it.
    const hint = document.querySelector(".sse-controlsHint:not(.sse-hidden) .sse-controlsHintClose");
    if (hint && (scene.client || matchMedia(SMALL).matches)) hint.click();
}
