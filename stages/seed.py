"""Reconstruction -> Splats: a robust start for training from the sparse points.

Follows the reference trainer (Kerbl et al., 3D Gaussian Splatting, 2023, section 5.1): one round
splat a point, as large as the mean distance to its three nearest neighbours, opacity 0.1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.errors import Family, SplatError
from stages.base.stage import Report, Stage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stages.scene import Reconstruction, Splats

OPACITY = 0.1
NEIGHBOURS = 3
_FEWEST_SPLATS = 50
_FAR = 8.0  # x the radius that holds nine tenths of the points, or of the cameras
_FAR_WEAK = 4.0  # the same for points that only two photographs see
_HIGH_ERROR = 4.0  # x the median reprojection error
_AT_A_CAMERA = 0.05  # of the typical distance from a point to its nearest camera
_FLOOR = 0.1  # of the median scale: duplicates have no distance between them
_CEILING = 0.05  # of the distance to the nearest camera: 3 degrees to either side


@dataclass(frozen=True)
class SeedSettings:
    """Settings of the start."""

    keep_outliers: bool = field(
        default=False,
        metadata={"help": "Also start splats at points that look misplaced or far away."},
    )
    fill: bool = field(
        default=True,
        metadata={"help": "Also start splats where photographs show a surface without points."},
    )


def run(inputs: Mapping[str, Any], settings: SeedSettings, folder: Path, report: Report) -> Splats:
    """Splats of degree 0 from inputs["sfm"], written to `folder`.

    Raises SplatError "seed-too-few-points" if fewer than 50 points are worth starting from.
    """
    import numpy as np

    from stages.scene import Splats, draw_settings_of, logit, rgb_to_dc
    from stages.scene.storage import save_splats

    reconstruction: Reconstruction = inputs["sfm"]
    finite: NDArray[np.bool_] = np.all(np.isfinite(reconstruction.points), axis=1)
    keep = finite.copy()
    reasons: dict[str, NDArray[np.bool_]] = {"not_finite": ~finite}
    if not settings.keep_outliers and finite.any():
        reasons |= _outliers(reconstruction, finite)
        for left_out in reasons.values():
            keep &= ~left_out
    _report_counts(reasons, len(reconstruction.points), report)
    points = reconstruction.points[keep]
    if len(points) < _FEWEST_SPLATS:
        raise _too_few(len(points), len(reconstruction.points))
    colours = reconstruction.colours[keep].astype(np.float64) / 255.0
    if settings.fill:
        points, colours = _with_agreed(reconstruction, points, colours, report)
    scales, clamped = _scales(points, reconstruction)
    report.metric("median_scale", float(np.median(scales)))
    report.metric("scales_clamped", clamped)
    if settings.fill:
        points, colours, scales = _filled(reconstruction, points, colours, scales, report)
    report.progress(1, 1, "seeding", splats=len(points))
    splats = Splats(
        means=points.astype(np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (len(points), 1)),
        log_scales=np.repeat(np.log(scales)[:, None], 3, axis=1).astype(np.float32),
        opacity_logits=np.full(len(points), logit(OPACITY), np.float32),
        sh=rgb_to_dc(colours)[:, None, :].astype(np.float32),
        sh_degrees=np.zeros(len(points), np.uint8),
        origin=reconstruction.origin.copy(),
        draw_settings=draw_settings_of(reconstruction.views),
    )
    save_splats(folder, splats)
    report.metric("splats", len(splats))
    return splats


def _with_agreed(
    reconstruction: Reconstruction,
    points: NDArray[np.float64],
    colours: NDArray[np.float64],
    report: Report,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """With the points that `sweep` finds. Held-out photographs lend none: they are the judges."""
    import numpy as np

    from stages.scene import split_held_out
    from stages.structure.seeding.plane_sweep import plane_sweep_points

    training, _ = split_held_out(reconstruction.views)
    more, more_colours = plane_sweep_points(reconstruction.folder, training, points)
    report.metric("plane_sweep_points", len(more))
    return np.concatenate([points, more]), np.concatenate([colours, more_colours])


def _filled(
    reconstruction: Reconstruction,
    points: NDArray[np.float64],
    colours: NDArray[np.float64],
    scales: NDArray[np.float64],
    report: Report,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """With what `coverage` adds. Held-out photographs lend no colours: they are the judges."""
    import numpy as np

    from stages.scene import split_held_out
    from stages.structure.seeding.empty_cells import fill_cells

    training, _ = split_held_out(reconstruction.views)
    cameras = tuple(view.camera for view in reconstruction.views)
    more, more_colours, more_scales = fill_cells(reconstruction.folder, training, points, cameras)
    report.metric("filled_cells", len(more))
    return (
        np.concatenate([points, more]),
        np.concatenate([colours, more_colours]),
        np.concatenate([scales, more_scales]),
    )


def load(folder: Path) -> Splats:
    """The splats of a finished folder."""
    from stages.scene.storage import load_splats

    return load_splats(folder)


def _outliers(
    reconstruction: Reconstruction, finite: NDArray[np.bool_]
) -> dict[str, NDArray[np.bool_]]:
    """[P] masks of points not to start from, by reason."""
    import numpy as np

    from stages.structure.seeding.neighbours import nearest_distance

    points = np.where(finite[:, None], reconstruction.points, 0.0)
    errors = np.nan_to_num(reconstruction.errors_px, nan=np.inf, posinf=np.inf)
    centres = _camera_centres(reconstruction)
    middle = np.median(points[finite], axis=0)
    distances = np.linalg.norm(points - middle, axis=1)
    # Cameras count too, so that a background is judged by the size of the whole capture.
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
    """([N] standard deviations in world units, how many were brought within bounds).

    The floor keeps duplicates from vanishing; the ceiling, an angle as seen from the nearest
    camera, keeps lonely points from covering the pictures.
    """
    import numpy as np

    from stages.structure.seeding.neighbours import mean_neighbour_distance, nearest_distance

    raw = mean_neighbour_distance(points, NEIGHBOURS)
    positive = raw[raw > 0]
    if not len(positive):
        raise _too_few(1, len(points))
    floor = _FLOOR * float(np.median(positive))
    ceiling = np.maximum(
        floor, _CEILING * nearest_distance(points, _camera_centres(reconstruction))
    )
    scales = np.clip(raw, floor, ceiling)
    return scales, int(np.sum(scales != raw))


def _camera_centres(reconstruction: Reconstruction) -> NDArray[np.float64]:
    import numpy as np

    return np.array([view.camera.centre for view in reconstruction.views]).reshape(-1, 3)


def _report_counts(reasons: dict[str, NDArray[np.bool_]], points: int, report: Report) -> None:
    import numpy as np

    counts = {reason: int(mask.sum()) for reason, mask in reasons.items()}
    total = int(np.logical_or.reduce(list(reasons.values())).sum()) if reasons else 0
    report.metric("points", points)
    report.metric("outliers", total)
    report.metric("outliers_by_reason", counts)
    if total > 0.2 * points:
        report.warn(
            "seed-many-outliers",
            f"{total} of {points} points look misplaced and were left out. Look at the result "
            "with care; photographs with more overlap give a cleaner start.",
        )


def _too_few(usable: int, points: int) -> SplatError:
    return SplatError(
        "seed-too-few-points",
        given=f"Only {usable} of {points} reconstructed points can be used.",
        wanted=f"At least {_FEWEST_SPLATS} distinct points to start from.",
        hint="Take more photographs with more overlap of a scene with texture, and begin again.",
        family=Family.RECONSTRUCTION,
    )


STAGE = Stage(
    name="seed", version=4, reads=("sfm",), settings_type=SeedSettings, run=run, load=load
)
