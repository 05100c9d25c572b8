"""A sparse model as arrays: the worker process writes it, and its parent reads it."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.sfm.checks.gates import THRESHOLDS

FEWEST_OBSERVATIONS = 15
IMPLAUSIBLE_SHARE = 0.1  # of the photographs


@dataclass(frozen=True)
class SparseModel:
    """V registered photographs, C cameras, P points, O observations, Q verified pairs.

    Args:
        names: [V].
        view_cameras: [V] index of each photograph's camera.
        view_frames: [V] number of each photograph's frame: the faces of a panorama share one.
        world_to_camera: [V, 4, 4].
        camera_sizes: [C, 2] width, height.
        camera_params: [C, 4] f, cx, cy, k of COLMAP's SIMPLE_RADIAL: x = f (1 + k r^2) u + cx with
            u = X / Z, r^2 = u^2 + v^2; pixels, pixel centres at +0.5.
        focal_priors_px: [C], NaN without EXIF.
        points: [P, 3].
        colours: [P, 3] uint8.
        observed_points, observing_views, observed_px: [O], [O], [O, 2]; sorted by point, then view.
        pairs: [Q, 2] indices of photographs that share many matches.
        pair_inlier_ratios: [Q] share of those matches that fits the poses of the model.
        pairs_turned: [Q] whether the matches that do not fit show another rotation of the scene, on
            which several pairs agree.
        rotations_to_others_deg: [M] for each smaller model with photographs in common: the largest
            disagreement about their relative rotations.
    """

    names: tuple[str, ...]
    view_cameras: NDArray[np.int32]
    view_frames: NDArray[np.int32]
    world_to_camera: NDArray[np.float64]
    camera_sizes: NDArray[np.int32]
    camera_params: NDArray[np.float64]
    focal_priors_px: NDArray[np.float64]
    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    observed_points: NDArray[np.int32]
    observing_views: NDArray[np.int32]
    observed_px: NDArray[np.float64]
    pairs: NDArray[np.int32]
    pair_inlier_ratios: NDArray[np.float64]
    pairs_turned: NDArray[np.bool_]
    rotations_to_others_deg: NDArray[np.float64]

    @property
    def centres(self) -> NDArray[np.float64]:
        """[V, 3] camera positions."""
        return camera_centres(self.world_to_camera)

    @property
    def tracks(self) -> NDArray[np.int32]:
        """[P] photographs that observe each point (COLMAP may list one twice in a track)."""
        first = np.ones(len(self.observed_points), np.bool_)
        first[1:] = (np.diff(self.observed_points) != 0) | (np.diff(self.observing_views) != 0)
        seen = self.observed_points[first]
        return np.bincount(seen, minlength=len(self.points)).astype(np.int32)


def camera_centres(world_to_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """[V, 3] positions of cameras [V, 4, 4]."""
    rotations, translations = world_to_camera[:, :3, :3], world_to_camera[:, :3, 3]
    return np.asarray(-np.einsum("vij,vi->vj", rotations, translations))


@dataclass(frozen=True)
class MappingResult:
    """model: the largest, or None. groups: names in each model found, largest first. timed_out:
    whether the mapper ran out of time."""

    model: SparseModel | None = None
    groups: tuple[tuple[str, ...], ...] = ()
    timed_out: bool = False


def save_model(
    folder: Path, model: SparseModel | None, *, groups: list[list[str]], timed_out: bool
) -> None:
    """Write a mapping's result; the folder appears when it is complete."""
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    arrays = {} if model is None else vars(model) | {"names": np.array(model.names)}
    np.savez(partial / "model.npz", **arrays)
    result = {"groups": groups, "timed_out": timed_out}
    (partial / "result.json").write_text(json.dumps(result), encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(partial, folder)


def load_result(folder: Path) -> MappingResult:
    """What `save_model` wrote. Raises OSError, ValueError or BadZipFile if it is missing
    or damaged."""
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    arrays = dict(np.load(folder / "model.npz"))
    model = SparseModel(**arrays | {"names": tuple(arrays["names"].tolist())}) if arrays else None
    groups = tuple(tuple(group) for group in result["groups"])
    return MappingResult(model=model, groups=groups, timed_out=bool(result["timed_out"]))


def without_implausible_views(model: SparseModel) -> SparseModel:
    """The model without photographs whose poses are unreliable: they observe fewer than 15 points,
    or have implausible intrinsics. If more than a tenth have implausible intrinsics, these stay:
    then the whole model is implausible, and the gates must refuse it."""
    frames = model.view_frames
    seen = np.bincount(frames[model.observing_views], minlength=int(frames.max()) + 1)
    keep = seen[frames] >= FEWEST_OBSERVATIONS
    with np.errstate(invalid="ignore"):
        zoom = np.abs(np.log(model.camera_params[:, 0] / model.focal_priors_px))
        implausible = (np.abs(model.camera_params[:, 3]) > THRESHOLDS.distortion) | (
            zoom > np.log(THRESHOLDS.focal_ratio)
        )
    views = implausible[model.view_cameras]
    if views.mean() <= IMPLAUSIBLE_SHARE:
        keep &= ~views
    return model if keep.all() else _with_views(model, keep)


def _with_views(model: SparseModel, keep_view: NDArray[np.bool_]) -> SparseModel:
    """The model of some of its views; drops points with fewer than two observations in these, and
    cameras without a view."""
    kept = keep_view[model.observing_views]
    tracks = np.bincount(model.observed_points[kept], minlength=len(model.points))
    keep_point = tracks >= 2
    kept &= keep_point[model.observed_points]
    new_view = np.cumsum(keep_view, dtype=np.int32) - 1
    new_point = np.cumsum(keep_point, dtype=np.int32) - 1
    keep_camera = np.zeros(len(model.camera_params), np.bool_)
    keep_camera[model.view_cameras[keep_view]] = True
    new_camera = np.cumsum(keep_camera, dtype=np.int32) - 1
    pairs = keep_view[model.pairs].all(axis=1)
    return replace(
        model,
        names=tuple(name for name, keep in zip(model.names, keep_view, strict=True) if keep),
        view_cameras=new_camera[model.view_cameras[keep_view]].astype(np.int32),
        camera_sizes=model.camera_sizes[keep_camera],
        camera_params=model.camera_params[keep_camera],
        focal_priors_px=model.focal_priors_px[keep_camera],
        view_frames=model.view_frames[keep_view],
        world_to_camera=model.world_to_camera[keep_view],
        points=model.points[keep_point],
        colours=model.colours[keep_point],
        observed_points=new_point[model.observed_points[kept]].astype(np.int32),
        observing_views=new_view[model.observing_views[kept]].astype(np.int32),
        observed_px=model.observed_px[kept],
        pairs=new_view[model.pairs[pairs]].astype(np.int32),
        pair_inlier_ratios=model.pair_inlier_ratios[pairs],
        pairs_turned=model.pairs_turned[pairs],
    )


def reprojection_errors(model: SparseModel) -> NDArray[np.float64]:
    """[O] distance in pixels between each observation and its point's projection."""
    poses = model.world_to_camera[model.observing_views]
    xyz = np.einsum("oij,oj->oi", poses[:, :3, :3], model.points[model.observed_points])
    xyz += poses[:, :3, 3]
    params = model.camera_params[model.view_cameras[model.observing_views]]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = xyz[:, :2] / xyz[:, 2:]
        factor = params[:, :1] * (1.0 + params[:, 3:] * np.sum(uv**2, axis=1, keepdims=True))
        errors = np.linalg.norm(uv * factor + params[:, 1:3] - model.observed_px, axis=1)
    return np.where(xyz[:, 2] > 0, errors, np.inf)


def point_errors(model: SparseModel) -> NDArray[np.float64]:
    """[P] mean reprojection error of each point, pixels (infinite without observations)."""
    total = np.bincount(
        model.observed_points, weights=reprojection_errors(model), minlength=len(model.points)
    )
    count = np.bincount(model.observed_points, minlength=len(model.points))
    return np.where(count > 0, total / np.maximum(count, 1), np.inf)
