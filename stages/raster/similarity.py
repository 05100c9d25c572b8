"""Similarity transforms of splats and cameras, view-dependent colour included.

A similarity takes a point x to scale * rotation @ x + offset.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.base import scratch
from stages.base.row_slices import row_slices
from stages.raster.sh import sh_basis
from stages.scene import Camera, Splats
from stages.scene.recentring import recentred
from stages.scene.rotations import quaternions_of

_SAMPLE = 4096
_UP = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True)
class Similarity:
    """A similarity transform: scale > 0, rotation [3, 3], offset [3], all float64."""

    scale: float = 1.0
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    @property
    def inverse_matrix(self) -> NDArray[np.float64]:
        """[4, 4] takes transformed points back."""
        linear = self.rotation.T / self.scale
        inverse = np.eye(4)
        inverse[:3, :3], inverse[:3, 3] = linear, -linear @ self.offset
        return inverse

    def after(self, first: Similarity) -> Similarity:
        """The transform that applies `first` and then this one."""
        offset = self.scale * self.rotation @ first.offset + self.offset
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, offset)

    def apply_to_camera(self, camera: Camera) -> Camera:
        """The camera that sees of the transformed scene what `camera` sees of the scene. Depths are
        scaled, too."""
        rotation = camera.world_to_camera[:3, :3] @ self.rotation.T
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = self.scale * camera.world_to_camera[:3, 3] - rotation @ self.offset
        return replace(camera, world_to_camera=pose)

    def apply_to_splats(self, splats: Splats) -> Splats:
        """The transformed splats. If float32 means end up far from zero, their offset moves into
        `origin`, so that they keep their precision."""
        linear, kind = self.scale * self.rotation, splats.means.dtype
        shift = self._shift(splats) if kind == np.float32 else np.zeros(3)
        means, logs, quaternions = (
            scratch.empty(array.shape, kind)
            for array in (splats.means, splats.log_scales, splats.quaternions)
        )
        sh = splats.sh
        left = self.offset - shift  # first: their difference is exact where both are large
        left_product = _left_product(quaternions_of(self.rotation))
        sh_rotation = _sh_rotation(self.rotation, splats.sh_degree)
        rotates = not np.array_equal(self.rotation, np.eye(3))
        if rotates and splats.sh_degree:
            sh = scratch.empty(splats.sh.shape, splats.sh.dtype)
        for rows in row_slices(len(splats)):
            with np.errstate(over="ignore"):  # what becomes infinite is left out and counted
                means[rows] = splats.means[rows].astype(np.float64) @ linear.T + left
            logs[rows] = splats.log_scales[rows] + np.log(self.scale)
            quaternions[rows] = splats.quaternions[rows].astype(np.float64) @ left_product.T
            if sh is not splats.sh:
                sh[rows] = np.einsum("km,nmc->nkc", sh_rotation, splats.sh[rows].astype(np.float64))
        place = splats.place and splats.place.moved(self.inverse_matrix)
        in_means = replace(self, offset=left)
        camera = splats.first_camera and in_means.apply_to_camera(splats.first_camera)
        return replace(
            splats,
            means=means,
            quaternions=quaternions if rotates else splats.quaternions,
            log_scales=logs,
            sh=sh,
            origin=linear @ splats.origin + shift + 0.0,
            place=place,
            first_camera=camera,
            draw_settings=replace(
                splats.draw_settings, near=splats.draw_settings.near * self.scale
            ),
        )

    def _shift(self, splats: Splats) -> NDArray[np.float64]:
        """[3] the part of the transformed means that belongs into the origin, from a sample."""
        sample = splats.means[:: max(1, len(splats) // _SAMPLE)].astype(np.float64)
        moved = sample @ (self.scale * self.rotation).T + self.offset
        return recentred(moved, np.zeros(3))[1]


def rotation_about(axis: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """[3, 3] the rotation about `axis` [3], right-handed."""
    turn = np.deg2rad(degrees) * axis / np.linalg.norm(axis)
    return np.asarray(Rotation.from_rotvec(turn).as_matrix())


def rotation_to_up(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] the smallest rotation that takes the direction `up` [3] to our up direction, -y."""
    unit = up / np.linalg.norm(up)
    axis = np.cross(unit, _UP)
    if np.linalg.norm(axis) < 1e-12:
        return np.eye(3) if unit @ _UP > 0 else rotation_about(np.array([1.0, 0, 0]), 180)
    return rotation_about(axis, np.rad2deg(np.arctan2(np.linalg.norm(axis), unit @ _UP)))


def _left_product(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] the matrix that multiplies a quaternion w, x, y, z by q from the left."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _sh_rotation(rotation: NDArray[np.float64], sh_degree: int) -> NDArray[np.float64]:
    """[K, K] the matrix that rotates SH coefficients.

    The rotated function at a direction d is the original at rotation.T @ d. Coefficients of one
    degree only mix among themselves, so the values at more directions than a degree has
    coefficients determine the matrix by least squares. The basis is the rasteriser's own, so its
    signs and order are not repeated here.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rotated = sh_basis(directions, sh_degree)
    original = sh_basis(directions @ rotation, sh_degree)
    matrix = np.zeros((rotated.shape[1], rotated.shape[1]))
    for degree in range(sh_degree + 1):
        own = slice(degree * degree, (degree + 1) ** 2)
        matrix[own, own] = np.linalg.lstsq(rotated[:, own], original[:, own], rcond=None)[0]
    return matrix
