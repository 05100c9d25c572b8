"""Additional test views of the sample, from viewpoints that no photograph of it was taken from.

Three held-out views are too few to compare presets by. The sample's own renderer draws more:
between the viewpoints of the capture, closer, and higher. The true cameras are mapped to a
reconstruction by the similarity that fits the cameras of the photographs best.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sample_captures import make
from sample_captures.render import Lens, Light, photograph
from stages.evaluate.evaluation import EvaluationView, load_evaluation_views
from stages.scene import Camera, DrawSettings, Reconstruction, View
from stages.scene.rotations import similarity

TRUTH = Path(make.__file__).parent / "still_life" / "truth.json"
PINHOLE = Lens(width=640, height=480, focal_px=600.0, k=0.0)
# Position along the capture's arc, y, and distance from the axis (metres): between its two rings,
# then closer, then higher.
PLACES = (
    *((2.5, -0.60, 1.36), (5.5, -0.40, 1.38), (8.5, -0.80, 1.30), (11.5, -0.60, 1.36)),
    *((14.5, -0.38, 1.40), (17.5, -0.84, 1.30), (20.5, -0.60, 1.36)),
    *((5.0, -0.55, 1.02), (12.0, -0.50, 1.00), (18.0, -0.60, 1.02)),
    *((7.0, -1.12, 1.08), (15.0, -1.12, 1.08)),
)
HIGHER = 2  # the last of PLACES: no photograph looks down as steeply
Poses = Mapping[str, NDArray[np.float64]]
_SHAKE_M = 0.04  # of the point looked at


def poses() -> list[NDArray[np.float64]]:
    """[4, 4] world_to_camera of each test view, in the world of the truth."""
    rng = np.random.default_rng(99)
    found = []
    for place, y, distance in PLACES:
        share = place / (make.PHOTOGRAPHS - 1) - 0.5
        angle = np.radians(-90 + make.ARC_DEGREES * share)
        eye = np.array([distance * np.cos(angle), y, distance * np.sin(angle)])
        found.append(make.look_at(eye, np.array(make.TARGET) + rng.normal(0, _SHAKE_M, 3)))
    return found


def render_test_views(folder: Path) -> None:
    """Draw those that are not in `folder` yet, some seconds each."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, pose in enumerate(poses()):
        path = folder / f"test_{number:02d}.png"
        if not path.exists():
            Image.fromarray(photograph(list(make.scene()), Light(), PINHOLE, pose)).save(path)


def evaluation_views(
    folder: Path, reconstruction: Reconstruction, settings: DrawSettings, truth: Poses | None = None
) -> Sequence[EvaluationView]:
    """The test views, drawn into `folder` if they are not there, in the world of the
    `reconstruction`. truth: world_to_camera [4, 4] by name of photograph or panorama; None: of the
    sample."""
    render_test_views(folder)
    return load_evaluation_views(folder, held_out_views_in(reconstruction, truth), settings)


def held_out_views_in(
    reconstruction: Reconstruction, truth: Poses | None = None
) -> tuple[View, ...]:
    """The test views in the world of this reconstruction. truth: as of `evaluation_views`."""
    truth = truth or {
        photo["name"]: np.array(photo["world_to_camera"])
        for photo in json.loads(TRUTH.read_text(encoding="utf-8"))["photos"]
    }
    seen = [view.frame or view.name for view in reconstruction.views]
    theirs = np.array([_centre(truth[name]) for name in seen])
    ours = np.array([view.camera.centre for view in reconstruction.views])
    scale, rotation, offset = similarity(theirs, ours)
    views = []
    for number, pose in enumerate(poses()):
        moved = np.eye(4)
        moved[:3, :3] = pose[:3, :3] @ rotation.T
        moved[:3, 3] = -moved[:3, :3] @ (scale * rotation @ _centre(pose) + offset)
        width, height, focal = PINHOLE.width, PINHOLE.height, PINHOLE.focal_px
        camera = Camera(width, height, focal, focal, width / 2, height / 2, moved)
        views.append(View(f"test_{number:02d}", f"test_{number:02d}.png", camera))
    return tuple(views)


def _centre(world_to_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(-world_to_camera[:3, :3].T @ world_to_camera[:3, 3])
