"""Warns of circular fisheye pictures without known cameras."""

from __future__ import annotations

from stages.base.stage import Report
from stages.ingest.image_circle import LOOKED_AT, always_same_circle
from stages.scene import Capture, evenly_spaced
from stages.sfm.undistorted_images import read_picture


def warn_of_circular_fisheye(capture: Capture, report: Report) -> None:
    """Warn if most of the photographs without a mask show an image circle. A mask says what is no
    part of the scene, as for an endoscope. Raises SplatError "sfm-photo-unreadable"."""
    bare = [photo for photo in capture.photos if photo.face is None and not photo.mask]
    chosen = evenly_spaced(bare, LOOKED_AT)
    if always_same_circle(read_picture(capture.folder / photo.image) for photo in chosen):
        report.warn(
            "sfm-circular-fisheye",
            "Photographs show a circle on black, as those of a circular fisheye do. Structure from "
            "motion takes every lens for nearly a pinhole, so cameras are likely to be wrong. Give "
            "--cameras with a fisheye model, or photograph with an ordinary lens. If the lens is "
            "an ordinary one, give masks that leave the black out.",
        )
