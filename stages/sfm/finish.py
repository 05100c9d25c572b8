"""From an accepted sparse model to a levelled, recentred, scaled and undistorted reconstruction."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.base.stage import Report
from stages.cameras.camera_file import FilePoints
from stages.cameras.colmap import Observations, write_model
from stages.cameras.undistortion import SimpleRadial, undistorted_px
from stages.scene import Camera, Capture, Photo, Reconstruction, View
from stages.sfm.place.gps import MetricScale
from stages.sfm.place.levelling import level_and_recentre
from stages.sfm.place.metric_scale import UNKNOWN_SCALE, KnownScale, find_metric_scale
from stages.sfm.undistorted_images import (
    IMAGES,
    PosedPhoto,
    depth_file,
    mask_file,
    write_undistorted_images,
)
from stages.sfm.worker.sparse_model import SparseModel, point_errors

COLMAP = "colmap"
SPARSE = f"{COLMAP}/sparse/0"


def finish(
    model: SparseModel,
    capture: Capture,
    folder: Path,
    report: Report,
    known_scale: KnownScale = UNKNOWN_SCALE,
) -> Reconstruction:
    """Level, recentre and scale `model`; write undistorted pictures and a COLMAP model of them.

    The reconstruction that is returned is not stored yet (`reconstruction_files`). Raises
    Interrupted, and SplatError "sfm-photo-unreadable" if a photograph has gone.
    """
    shutil.rmtree(folder / COLMAP, ignore_errors=True)  # may be left of an interrupted run
    model, levelled = level_and_recentre(model)
    by_image = {photo.image: photo for photo in capture.photos}
    photos = [by_image[name] for name in model.names]
    posed = _posed(photos, model)
    cameras, _ = write_undistorted_images(posed, capture.folder, folder, report)
    pictures = [folder / IMAGES / photo.picture for photo in photos]
    scale = find_metric_scale(known_scale, photos, cameras, pictures, levelled, report)
    if scale is not None:
        poses, points = scale.poses(model.world_to_camera), scale.points(model.points)
        model = replace(model, world_to_camera=poses, points=points)
        cameras = scale.cameras(cameras)
    observed_px = np.empty_like(model.observed_px)
    camera_of = model.view_cameras[model.observing_views]
    for number in np.unique(model.view_cameras):
        mine, view = camera_of == number, int(np.argmax(model.view_cameras == number))
        taken = posed[view]
        observed_px[mine] = undistorted_px(
            model.observed_px[mine], taken.camera, taken.lens, cameras[view]
        )
    return write_reconstruction(
        folder,
        photos,
        cameras,
        FilePoints(model.points, model.colours, point_errors(model), model.tracks),
        Observations(model.observed_points, model.observing_views, observed_px),
        levelled=levelled,
        metric=scale,
    )


def _posed(photos: Sequence[Photo], model: SparseModel) -> list[PosedPhoto]:
    """The photographs [V] with the model's cameras."""
    posed = []
    views = zip(photos, model.view_cameras, model.world_to_camera, strict=True)
    for photo, number, pose in views:
        width, height = (int(side) for side in model.camera_sizes[number])
        focal, cx, cy, k = (float(value) for value in model.camera_params[number])
        camera = Camera(width, height, focal, focal, cx, cy, pose)
        posed.append(PosedPhoto(photo, camera, SimpleRadial(radial=(k,))))
    return posed


def write_reconstruction(
    folder: Path,
    photos: Sequence[Photo],
    cameras: Sequence[Camera],
    cloud: FilePoints,
    observations: Observations,
    *,
    levelled: bool,
    metric: MetricScale | None,
) -> Reconstruction:
    """Write the COLMAP model of the undistorted pictures, and return the reconstruction.

    Args:
        folder: of the reconstruction.
        photos, cameras: [V].
        cloud: the points.
        observations: of these points.
        levelled: whether up is -Y.
        metric: how the world became metric; None if it is not.
    """
    names = [photo.picture for photo in photos]
    write_model(folder / SPARSE, names, cameras, cloud, observations)
    views = tuple(
        View(
            photo.name,
            f"{IMAGES}/{photo.picture}",
            camera,
            photo.duplicate_of,
            mask=mask_file(photo),
            outside=photo.outside,
            frame=photo.face.frame if photo.face else "",
            depth=depth_file(photo),
        )
        for photo, camera in zip(photos, cameras, strict=True)
    )
    return Reconstruction(
        folder=folder,
        views=views,
        points=cloud.points,
        colours=cloud.colours,
        errors_px=cloud.errors_px,
        tracks=cloud.tracks,
        levelled=levelled,
        units="metres" if metric else "arbitrary",
        place=metric.place if metric else None,
    )
