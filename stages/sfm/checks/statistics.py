"""Statistics of a sparse model, which the gates check."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from stages.scene.capture import PHOTOS_FOLDER
from stages.sfm.checks.gates import ModelStatistics
from stages.sfm.worker.sparse_model import MappingResult, SparseModel, point_errors

CONSISTENT_RATIO = 0.25  # of a pair's matches: good models have 0.9 and more, false ones 0.05
_SAMPLED_POINTS = 4000  # every pair of rays of a point is compared, so a sample must do
_SAMPLED_RAYS = 24
_SMALLEST_PART = 0.1  # of the photographs; a few outer ones may be weakly connected


def model_statistics(result: MappingResult, photographs: int) -> ModelStatistics:
    """The statistics that the gates check. photographs: how many were given. The faces of a
    panorama count as one."""
    model = result.model
    sizes = tuple(len(group) for group in result.groups)
    if model is None or not model.names:
        return ModelStatistics(photographs=photographs, models=sizes, timed_out=result.timed_out)
    sample = np.arange(0, len(model.points), max(1, len(model.points) // _SAMPLED_POINTS))
    angles = triangulation_angles(model, sample)
    errors = point_errors(model)
    misfit = model.pair_inlier_ratios < CONSISTENT_RATIO
    inconsistent = np.flatnonzero(misfit | model.pairs_turned)
    registered, frames = np.unique(model.view_frames, return_inverse=True)
    cut_points, part = weakest_cut(
        model.observed_points, frames[model.observing_views], len(registered)
    )
    return ModelStatistics(
        photographs=photographs,
        registered=len(registered),
        models=sizes,
        timed_out=result.timed_out,
        points=len(model.points),
        mean_reprojection_error_px=float(errors.mean()) if len(errors) else 0.0,
        long_side_px=int(model.camera_sizes.max()),
        mean_track_length=float(model.tracks.mean()) if len(model.points) else 0.0,
        median_triangulation_angle_deg=float(np.median(angles)) if len(angles) else 0.0,
        baseline_over_depth=baseline_over_depth(model),
        flatness=flatness(model.points) if len(model.points) > 3 else 1.0,
        sideways_share=sideways_share(model),
        distortion=_largest(model.camera_params[:, 3]),
        focal_over_prior=_focal_over_prior(model),
        pairs_checked=len(model.pairs),
        pairs_inconsistent=len(inconsistent),
        pairs_turned=len(inconsistent) - int(misfit.sum()),
        inconsistent_pair=_names(model, model.pairs[inconsistent[0]]) if len(inconsistent) else (),
        rotation_to_other_deg=float(model.rotations_to_others_deg.max(initial=0.0)),
        cut_points=cut_points,
        cut_views=len(part),
    )


def triangulation_angles(model: SparseModel, index: NDArray[np.integer]) -> NDArray[np.float64]:
    """[len(index)] largest angle, in degrees, between the rays of two photographs to each point."""
    starts = np.searchsorted(model.observed_points, np.arange(len(model.points) + 1))
    centres = model.centres
    angles = np.zeros(len(index))
    for i, point in enumerate(index):
        views = model.observing_views[starts[point] : starts[point + 1]]
        if len(views) < 2:
            continue
        step = -(-len(views) // _SAMPLED_RAYS)
        rays = centres[views[::step]] - model.points[point]
        lengths = np.linalg.norm(rays, axis=1, keepdims=True)
        rays = rays / np.maximum(lengths, 1e-300)
        angles[i] = np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)))
    return angles


def baseline_over_depth(model: SparseModel) -> float:
    """Spread of the cameras (twice the 90th percentile of distances from their median position)
    over the median distance from a camera to a point that it observes."""
    if not len(model.observed_points):
        return 0.0
    centres = model.centres
    spread = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    rays = model.points[model.observed_points] - centres[model.observing_views]
    depth = float(np.median(np.linalg.norm(rays, axis=1)))
    return 2.0 * float(np.percentile(spread, 90)) / max(depth, 1e-300)


def flatness(points: NDArray[np.float64]) -> float:
    """Standard deviation of points [P, 3] across their best plane over the smaller one within it;
    the tenth of the points that is farthest from their median is left out."""
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    core = points[away <= np.percentile(away, 90)]
    variances = np.linalg.eigvalsh(np.cov(core.T))
    return float(np.sqrt(max(variances[0], 0.0) / max(variances[1], 1e-300)))


def sideways_share(model: SparseModel) -> float:
    """Motion of the cameras from their median position: RMS of its part across each optical axis,
    over RMS of the whole."""
    moved = model.centres - np.median(model.centres, axis=0)
    along = np.einsum("vi,vi->v", moved, model.world_to_camera[:, 2, :3])
    whole = float((moved**2).sum())
    return float(np.sqrt(max(0.0, 1.0 - (along**2).sum() / whole))) if whole else 0.0


def weakest_cut(
    points: NDArray[np.integer], views: NDArray[np.integer], photographs: int, fewest: int = 3
) -> tuple[int, tuple[int, ...]]:
    """Cut the photographs in two parts that have the fewest points in common: (points observed in
    both parts, photographs of the smaller part).

    Photographs are ordered by the second eigenvector of the normalised Laplacian of the graph of
    shared points (Fiedler 1973; Shi and Malik 2000), and each cut of that order is tried.

    Args:
        points, views: [O] observations.
        photographs: of the model.
        fewest: photographs of the smaller part, at least; and at least a tenth of all.

    If the model is too small to be cut: all points, and no views.
    """
    count = int(points.max(initial=-1)) + 1
    smallest = max(fewest, round(_SMALLEST_PART * photographs))
    if photographs < 2 * smallest:
        return count, ()
    shared = _shared(points, views, photographs)
    root = 1.0 / np.sqrt(np.maximum(shared.sum(axis=1), 1e-9))
    order = np.argsort(np.linalg.eigh(-root[:, None] * shared * root)[1][:, 1] * root)
    rank = np.empty(photographs, np.int64)
    rank[order] = np.arange(photographs)
    first, last = np.full(count, photographs), np.full(count, -1)
    np.minimum.at(first, points, rank[views])
    np.maximum.at(last, points, rank[views])
    observed = last >= 0
    change = np.bincount(first[observed], minlength=photographs).astype(np.int64)
    change -= np.bincount(last[observed], minlength=photographs)
    shared_points = np.cumsum(change)[smallest - 1 : photographs - smallest]
    cut = smallest + int(shared_points.argmin())
    part = order[:cut] if 2 * cut <= photographs else order[cut:]
    return int(shared_points.min()), tuple(sorted(part.tolist()))


def _shared(
    points: NDArray[np.integer], views: NDArray[np.integer], photographs: int
) -> NDArray[np.float64]:
    """[V, V] number of points that two photographs both observe."""
    shape = (photographs, int(points.max(initial=-1)) + 1)
    observes = csr_array((np.ones(len(points), np.bool_), (views, points)), shape).astype(
        np.float64
    )
    shared = np.asarray((observes @ observes.T).todense())
    np.fill_diagonal(shared, 0.0)
    return shared


def _names(model: SparseModel, views: NDArray[np.integer]) -> tuple[str, ...]:
    return tuple(model.names[view].removeprefix(PHOTOS_FOLDER) for view in views)


def _largest(values: NDArray[np.float64]) -> float:
    return float(values[np.argmax(np.abs(values))]) if len(values) else 0.0


def _focal_over_prior(model: SparseModel) -> float | None:
    """The ratio that is farthest from 1, or None without priors."""
    ratios = model.camera_params[:, 0] / model.focal_priors_px
    ratios = ratios[np.isfinite(ratios)]
    return float(ratios[np.argmax(np.abs(np.log(ratios)))]) if len(ratios) else None
