"""The same capture in another world: turned, mirrored, in another unit of length.

What a run makes of photographs should not depend on how the world of its cameras lies. That of
structure from motion is levelled, its heading is by chance; that of a camera file lies anyhow.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.raster.similarity import rotation_about
from stages.scene import Reconstruction, Splats, View
from stages.seed.axes import surface_rotations

_FLIP = np.diag([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class World:
    """A point x of the capture is at scale * turn @ x. turn: [3, 3], orthogonal; with determinant
    -1 the world is mirrored, and so are the photographs."""

    turn: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0

    @property
    def mirrored(self) -> bool:
        return bool(np.linalg.det(self.turn) < 0)

    def points(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """[N, 3] where points [N, 3] of the capture are."""
        return np.asarray(self.scale * points.astype(np.float64) @ self.turn.T)


def _about(x: float, y: float, z: float, degrees: float) -> NDArray[np.float64]:
    return rotation_about(np.array([x, y, z]), degrees)


WORLDS = {
    "as it is": World(),
    "0.1 % longer": World(scale=1.001),
    "in millimetres": World(scale=1000.0),
    "quarter turn about x": World(_about(1, 0, 0, 90)),
    "quarter turn about y": World(_about(0, 1, 0, 90)),
    "quarter turn about z": World(_about(0, 0, 1, 90)),
    "turned anyhow": World(_about(0.3, -0.8, 0.5, 131)),
    "turned otherwise": World(_about(-0.7, 0.2, 0.7, 58)),
    "mirrored": World(_FLIP),
}
"""Where rounding decides, "0.1 % longer" says by how much equal worlds differ."""


def in_world(made: Reconstruction, world: World, folder: Path) -> Reconstruction:
    """The capture, which has neither masks nor depth maps, in `world`. folder: receives the
    photographs if they have to be mirrored."""
    assert not any(view.mask or view.depth for view in made.views)
    if world.mirrored:
        for view in made.views:
            _write_mirrored(made.folder, view, folder)
    return replace(
        made,
        folder=folder if world.mirrored else made.folder,
        views=tuple(_view(view, world) for view in made.views),
        points=world.points(made.points),
        origin=np.zeros(3),
    )


def _view(view: View, world: World) -> View:
    camera = view.camera
    pose = camera.world_to_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ world.turn.T
    pose[:3, 3] *= world.scale
    if not world.mirrored:
        return replace(view, camera=replace(camera, world_to_camera=pose))
    pose[:3] = _FLIP @ pose[:3]
    flipped = replace(camera, cx=camera.width - camera.cx, world_to_camera=pose)
    return replace(view, camera=flipped)


def _write_mirrored(source: Path, view: View, target: Path) -> None:
    """Losslessly, whatever the suffix says: readers go by the content."""
    how = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    picture = cv2.imdecode(np.fromfile(source / view.image, np.uint8), how)
    path = target / view.image
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imencode(".png", np.ascontiguousarray(np.asarray(picture)[:, ::-1]))[1].tofile(path)


def seeds_in_world(seeds: Splats, world: World, made: Reconstruction) -> Splats:
    """Seeds of the capture `made`, which are spheres of one colour, in `world`, as the seed stage
    makes them there. made: in that world."""
    means, cameras = world.points(seeds.means), [view.camera for view in made.views]
    return replace(
        seeds,
        means=means.astype(np.float32),
        quaternions=surface_rotations(means, cameras).astype(np.float32),
        log_scales=(seeds.log_scales + np.log(world.scale)).astype(np.float32),
        origin=np.zeros(3),
        draw_settings=replace(seeds.draw_settings, near=world.scale * seeds.draw_settings.near),
    )
