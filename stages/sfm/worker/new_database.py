"""A new COLMAP database with cameras and photographs (imports pycolmap)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from stages.scene.rotations import matrices_of
from stages.sfm.worker import database as sqlite
from stages.sfm.worker.job import CameraGuess, Photographs

FOCAL_WITHOUT_PRIOR = 1.2  # x the longer side: COLMAP's guess without EXIF


def create(path: Path, photographs: Photographs) -> None:
    """Write a database with cameras and photographs, ids = position + 1; it appears at `path` when
    it is complete.

    COLMAP's own import would trust EXIF focal lengths that are wrong after resizing.
    """
    partial = path.with_name(path.name + ".partial")
    sqlite.delete(partial)
    database = pycolmap.Database.open(partial)
    rig_of = _write_rigs(database, photographs.cameras)
    frames: dict[int, pycolmap.Frame] = {}
    columns = photographs.names, photographs.camera_of, photographs.frame_of
    for image_id, (name, position, number) in enumerate(zip(*columns, strict=True), 1):
        image = pycolmap.Image()
        image.image_id = image_id
        image.name = name
        image.camera_id = position + 1
        database.write_image(image, use_image_id=True)
        frame = frames.setdefault(number, pycolmap.Frame())
        frame.frame_id = number + 1
        frame.rig_id = rig_of[position]
        frame.add_data_id(image.data_id)
    for frame in frames.values():
        database.write_frame(frame, use_frame_id=True)
    database.close()
    os.replace(partial, path)


def _write_rigs(database: pycolmap.Database, cameras: Sequence[CameraGuess]) -> list[int]:
    """Write cameras and rigs; returns the id of each camera's rig. A rig has the id of its first
    camera, which is its reference."""
    rig_of: list[int] = []
    first: dict[str, int] = {}
    rigs: dict[int, pycolmap.Rig] = {}
    for camera_id, guess in enumerate(cameras, 1):
        rig_id = first.setdefault(guess.rig, camera_id) if guess.rig else camera_id
        rig_of.append(rig_id)
        camera = _camera(camera_id, guess)
        database.write_camera(camera, use_camera_id=True)
        rig = rigs.setdefault(rig_id, pycolmap.Rig())
        if rig_id == camera_id:
            rig.rig_id = rig_id
            rig.add_ref_sensor(camera.sensor_id)
        else:
            turn, reference = (matrices_of(np.array(c.turn)) for c in (guess, cameras[rig_id - 1]))
            relative = pycolmap.Rotation3d(turn @ reference.T)
            rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(relative, np.zeros(3)))
    for rig in rigs.values():
        database.write_rig(rig, use_rig_id=True)
    return rig_of


def _camera(camera_id: int, guess: CameraGuess) -> pycolmap.Camera:
    focal_px = guess.focal_px or FOCAL_WITHOUT_PRIOR * max(guess.width, guess.height)
    camera = pycolmap.Camera.create_from_model_name(
        camera_id, "SIMPLE_RADIAL", focal_px, guess.width, guess.height
    )
    camera.has_prior_focal_length = guess.focal_px is not None
    return camera
