"""A COLMAP model of a capture, whose numbers are known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.cameras.camera_file import FilePoints
from stages.cameras.colmap import Observations, write_model
from stages.scene import Camera
from tests.sfm.synthetic import orbit_model


@dataclass(frozen=True)
class Model:
    """Arguments of `write_model`."""

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cloud: FilePoints
    observations: Observations

    def write(self, folder: Path) -> None:
        write_model(folder, self.names, self.cameras, self.cloud, self.observations)


def example() -> Model:
    """Five views, two of them with another focal length; pinhole observations."""
    model = orbit_model(views=5, points=30)
    focals = (500.0, 500.0, 510.0, 510.0, 500.0)
    cameras = tuple(
        Camera(640, 480, focal, focal, 320.0, 240.0, pose)
        for focal, pose in zip(focals, model.world_to_camera, strict=True)
    )
    keep = (model.observed_points + model.observing_views) % 4 != 0
    points, views = model.observed_points[keep], model.observing_views[keep]
    poses = model.world_to_camera[views]
    xyz = np.einsum("oij,oj->oi", poses[:, :3, :3], model.points[points]) + poses[:, :3, 3]
    px = np.array(focals)[views, None] * xyz[:, :2] / xyz[:, 2:] + (320.0, 240.0)
    tracks = np.bincount(points, minlength=30).astype(np.int32)
    return Model(
        names=("a.jpg", "day 1/b.jpg", "ü.jpg", "d.jpg", "e.jpg"),
        cameras=cameras,
        cloud=FilePoints(model.points, model.colours, np.linspace(0, 1, 30), tracks),
        observations=Observations(points, views, px),
    )
