"""A new COLMAP database with cameras and photographs (imports pycolmap)."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

import pycolmap

from stages.structure import database as sqlite
from stages.structure.job import CameraGuess, Job

FOCAL_WITHOUT_PRIOR = 1.2  # x the longer side: COLMAP's guess without EXIF


def create(path: Path, job: Job, only: Collection[int] | None = None) -> None:
    """Write a database with cameras and photographs, ids = position + 1; it appears at `path` when
    it is complete. only: positions of the photographs to write, by default all.

    COLMAP's own import would trust EXIF focal lengths that are wrong after resizing.
    """
    partial = path.with_name(path.name + ".partial")
    sqlite.delete(partial)
    database = pycolmap.Database.open(partial)
    for camera_id, guess in enumerate(job.cameras, 1):
        camera = _camera(camera_id, guess)
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig()
        rig.rig_id = camera_id
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for image_id, (name, position) in enumerate(zip(job.names, job.camera_of, strict=True), 1):
        if only is not None and image_id - 1 not in only:
            continue
        image = pycolmap.Image()
        image.image_id = image_id
        image.name = name
        image.camera_id = position + 1
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame()
        frame.frame_id = image_id
        frame.rig_id = position + 1
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
    database.close()
    os.replace(partial, path)


def _camera(camera_id: int, guess: CameraGuess) -> pycolmap.Camera:
    focal_px = guess.focal_px or FOCAL_WITHOUT_PRIOR * max(guess.width, guess.height)
    camera = pycolmap.Camera.create_from_model_name(
        camera_id, "SIMPLE_RADIAL", focal_px, guess.width, guess.height
    )
    camera.has_prior_focal_length = guess.focal_px is not None
    return camera
