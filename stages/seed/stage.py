"""Stage 3: Reconstruction -> Splats: initial splats at sparse points, and where there are none, or
the `given` ones of another program, with first splats where these leave pictures `uncovered`.

Follows the reference trainer (Kerbl et al., 3D Gaussian Splatting, 2023, section 5.1): one round
splat a point, as large as the mean distance to its three nearest neighbours, opacity 0.1. Its axes
are those of the surface around it (`axes`). Outliers are left out; points of a plane sweep,
measured depth and filled cells are added.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import ReconstructionError, SplatError
from stages.base.stage import Report
from stages.formats.values import concatenate
from stages.scene import (
    Reconstruction,
    Splats,
    View,
    draw_settings_of,
    logit,
    rgb_to_dc,
    split_held_out,
)
from stages.scene.capture import geometric_median
from stages.scene.storage import load_splats, save_splats
from stages.seed.axes import surface_rotations
from stages.seed.empty_cells import fill_cells
from stages.seed.given import given_splats
from stages.seed.measured_depth import measured_points
from stages.seed.neighbours import mean_neighbour_distance, nearest_distance
from stages.seed.plane_sweep import plane_sweep_points
from stages.seed.settings import SeedSettings
from stages.seed.uncovered import uncovered
from stages.seed.view_selection import selected_views

OPACITY = 0.1
NEIGHBOURS = 3
_FEWEST_SPLATS = 50
_FAR = 8.0  # x the radius that contains nine tenths of the points, or of the cameras
_FAR_WEAK = 4.0  # the same for points with only two observations
_HIGH_ERROR = 4.0  # x the median reprojection error
_AT_A_CAMERA = 0.05  # x the median distance from a point to its nearest camera
_SMALLEST_SCALE = 0.1  # x the median scale: duplicates are at distance 0
_LARGEST_SCALE = 0.05  # x the distance to the nearest camera: 3 degrees to either side


def run(inputs: Mapping[str, Any], settings: SeedSettings, folder: Path, report: Report) -> Splats:
    """Splats of inputs["sfm"], written to `folder`.

    Raises SplatError "seed-too-few-points" if fewer than 50 points are usable, and as
    `given_splats`.
    """
    reconstruction: Reconstruction = inputs["sfm"]
    if settings.splats is not None:
        splats = given_splats(settings.splats, reconstruction, report)
        if settings.densify:
            splats = _with_first_splats(splats, reconstruction, settings, report)
    else:
        splats = _initial(reconstruction, settings, report)
    save_splats(folder, splats)
    report.metric("splats", len(splats))
    return splats


def load(folder: Path) -> Splats:
    """The splats of a finished folder."""
    return load_splats(folder)


def _with_first_splats(
    given: Splats, reconstruction: Reconstruction, settings: SeedSettings, report: Report
) -> Splats:
    """The given splats, and first ones where these leave the photographs uncovered."""
    try:
        first = _initial(reconstruction, settings, report)
    except ReconstructionError:  # too few points, which given splats do not need
        return given
    training, _ = split_held_out(reconstruction.views)
    first = first[uncovered(given, first.means.astype(np.float64), training)]
    report.metric("added_to_given", len(first))
    return replace(concatenate([given, first]), origin=given.origin)


def _initial(reconstruction: Reconstruction, settings: SeedSettings, report: Report) -> Splats:
    """Splats of SH degree 0 at points and where there are none."""
    keep = _usable(reconstruction, report)
    points = reconstruction.points[keep]
    if len(points) < _FEWEST_SPLATS:
        raise _too_few(len(points), len(reconstruction.points))
    colours = reconstruction.colours[keep].astype(np.float64) / 255.0
    training, _ = split_held_out(reconstruction.views)  # held-out views give no points or colours
    chosen = selected_views(training, points) if settings.fill else ()
    if settings.fill:
        points, colours = _with_depth_maps(reconstruction.folder, chosen, points, colours, report)
    scales, clamped = _scales(points, reconstruction)
    report.metric("median_scale", float(np.median(scales)))
    report.metric("scales_clamped", clamped)
    cameras = tuple(view.camera for view in training)
    if settings.fill:
        more, more_colours, more_scales = fill_cells(
            reconstruction.folder, chosen, points, cameras, training
        )
        report.metric("filled_cells", len(more))
        points, colours = np.concatenate([points, more]), np.concatenate([colours, more_colours])
        scales = np.concatenate([scales, more_scales])
    report.progress(1, 1, "seeding", splats=len(points))
    return Splats(
        means=points.astype(np.float32),
        quaternions=surface_rotations(points, cameras).astype(np.float32),
        log_scales=np.repeat(np.log(scales)[:, None], 3, axis=1).astype(np.float32),
        opacity_logits=np.full(len(points), logit(OPACITY), np.float32),
        sh=rgb_to_dc(colours)[:, None, :].astype(np.float32),
        sh_degrees=np.zeros(len(points), np.uint8),
        origin=reconstruction.origin.copy(),
        draw_settings=draw_settings_of(reconstruction),
    )


def _usable(reconstruction: Reconstruction, report: Report) -> NDArray[np.bool_]:
    """[P] the points to start from: finite, and no outliers."""
    finite: NDArray[np.bool_] = np.all(np.isfinite(reconstruction.points), axis=1)
    reasons: dict[str, NDArray[np.bool_]] = {"not_finite": ~finite}
    if finite.any():
        reasons |= _outliers(reconstruction, finite)
    keep = ~np.logical_or.reduce(list(reasons.values()))
    _report_outliers(reasons, keep, report)
    return np.asarray(keep)


def _with_depth_maps(
    folder: Path,
    views: tuple[View, ...],
    points: NDArray[np.float64],
    colours: NDArray[np.float64],
    report: Report,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points [P, 3] and colours [P, 3] with those of a plane sweep and of measured depth."""
    more, more_colours = plane_sweep_points(folder, views, points)
    report.metric("plane_sweep_points", len(more))
    points, colours = np.concatenate([points, more]), np.concatenate([colours, more_colours])
    if any(view.depth for view in views):
        more, more_colours = measured_points(folder, views, points, report)
        report.metric("measured_points", len(more))
        points, colours = np.concatenate([points, more]), np.concatenate([colours, more_colours])
    return points, colours


def _outliers(
    reconstruction: Reconstruction, finite: NDArray[np.bool_]
) -> dict[str, NDArray[np.bool_]]:
    """Masks [P] of outliers, by reason."""
    points = np.where(finite[:, None], reconstruction.points, 0.0)
    errors = np.nan_to_num(reconstruction.errors_px, nan=np.inf, posinf=np.inf)
    centres = _camera_centres(reconstruction)
    middle = geometric_median(points[finite])
    distances = np.linalg.norm(points - middle, axis=1)
    # Cameras count, too: a far background is normal for a capture of that size.
    reach = float(np.percentile(distances[finite], 90))
    if len(centres):
        reach = max(reach, float(np.percentile(np.linalg.norm(centres - middle, axis=1), 90)))
    far = np.where(reconstruction.tracks > 2, _FAR, _FAR_WEAK) * reach
    to_camera = nearest_distance(points, centres)
    typical_error = float(np.median(errors[finite]))
    return {
        "far_away": finite & (distances > far),
        "at_a_camera": finite & (to_camera < _AT_A_CAMERA * np.median(to_camera[finite])),
        "high_error": finite & (errors > _HIGH_ERROR * typical_error) & (errors > 1.0),
    }


def _scales(
    points: NDArray[np.float64], reconstruction: Reconstruction
) -> tuple[NDArray[np.float64], int]:
    """([N] standard deviations in world units, how many were clamped).

    The lower bound keeps duplicates from vanishing. The upper bound, an angle seen from the nearest
    camera, keeps isolated points from covering the pictures.
    """
    raw = mean_neighbour_distance(points, NEIGHBOURS)
    positive = raw[raw > 0]
    if not len(positive):
        raise _too_few(1, len(points))
    smallest = _SMALLEST_SCALE * float(np.median(positive))
    largest = np.maximum(
        smallest, _LARGEST_SCALE * nearest_distance(points, _camera_centres(reconstruction))
    )
    scales = np.clip(raw, smallest, largest)
    return scales, int(np.sum(scales != raw))


def _camera_centres(reconstruction: Reconstruction) -> NDArray[np.float64]:
    """[V, 3] of the training views."""
    views, _ = split_held_out(reconstruction.views)
    return np.array([view.camera.centre for view in views]).reshape(-1, 3)


def _report_outliers(
    reasons: dict[str, NDArray[np.bool_]], keep: NDArray[np.bool_], report: Report
) -> None:
    counts = {reason: int(mask.sum()) for reason, mask in reasons.items()}
    points, total = len(keep), int((~keep).sum())
    report.metric("points", points)
    report.metric("outliers", total)
    report.metric("outliers_by_reason", counts)
    if total > 0.2 * points:
        report.warn(
            "seed-many-outliers",
            f"{total} of {points} points look misplaced and were left out. Check the result with "
            "care; photographs with more overlap give fewer outliers.",
        )


def _too_few(usable: int, points: int) -> SplatError:
    return ReconstructionError(
        "seed-too-few-points",
        given=f"Only {usable} of {points} reconstructed points can be used.",
        wanted=f"At least {_FEWEST_SPLATS} distinct points to start from.",
        hint="Take more photographs with more overlap of a scene with texture, and start again.",
    )
