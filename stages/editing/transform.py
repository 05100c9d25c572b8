"""Splats in another place: turned, scaled and moved, their view-dependent colour with them.

A similarity takes a point x of the capture to scale * rotation @ x + offset.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from stages.base import scratch
from stages.base.blocks import reported_blocks
from stages.raster.reference import sh_basis
from stages.scene import Camera, DrawSettings, Splats
from stages.scene.recentring import recentred
from stages.scene.rotations import quaternions_of

_SAMPLE = 4096
_UP = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True)
class Similarity:
    """scale > 0; rotation [3, 3]; offset [3]. float64."""

    scale: float = 1.0
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def after(self, first: Similarity) -> Similarity:
        """What does the same as `first` and then this."""
        turned = self.scale * self.rotation @ first.offset + self.offset
        return Similarity(self.scale * first.scale, self.rotation @ first.rotation, turned)

    def apply_to_camera(self, camera: Camera) -> Camera:
        """A camera that sees of the scene there what `camera` sees here; z is scaled too."""
        rotation = camera.world_to_camera[:3, :3] @ self.rotation.T
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = self.scale * camera.world_to_camera[:3, 3] - rotation @ self.offset
        return replace(camera, world_to_camera=pose)

    def draw_settings(self, draw_settings: DrawSettings) -> DrawSettings:
        return replace(draw_settings, near=draw_settings.near * self.scale)

    def apply_to_splats(self, splats: Splats) -> Splats:
        """The splats there. What is nowhere near the origin of their file is told from an origin
        beside it, so that positions keep their digits."""
        linear, kind = self.scale * self.rotation, splats.means.dtype
        shift = self._shift(splats) if kind == np.float32 else np.zeros(3)
        means, logs, quaternions = (
            scratch.empty(array.shape, kind)
            for array in (splats.means, splats.log_scales, splats.quaternions)
        )
        sh = splats.sh
        turn, bands = _product(quaternions_of(self.rotation)), _sh_turns(self.rotation, splats)
        turns = not np.array_equal(self.rotation, np.eye(3))
        if turns and splats.sh_degree:
            sh = scratch.empty(splats.sh.shape, splats.sh.dtype)
        for rows in reported_blocks(len(splats)):
            there = splats.means[rows].astype(np.float64) @ linear.T + self.offset
            means[rows] = there - shift
            logs[rows] = splats.log_scales[rows] + np.log(self.scale)
            quaternions[rows] = splats.quaternions[rows].astype(np.float64) @ turn.T
            if sh is not splats.sh:
                sh[rows] = np.einsum("km,nmc->nkc", bands, splats.sh[rows].astype(np.float64))
        return replace(
            splats,
            means=means,
            quaternions=quaternions if turns else splats.quaternions,
            log_scales=logs,
            sh=sh,
            origin=linear @ splats.origin + shift + 0.0,
            draw_settings=self.draw_settings(splats.draw_settings),
        )

    def _shift(self, splats: Splats) -> NDArray[np.float64]:
        """[3] what is better told by the origin than by each splat, as a sample says."""
        sample = splats.means[:: max(1, len(splats) // _SAMPLE)].astype(np.float64)
        there = sample @ (self.scale * self.rotation).T + self.offset
        return recentred(there, np.zeros(3))[1]


def rotation_about(axis: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """[3, 3] a turn about `axis`, by the right hand's rule."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(degrees)
    turned = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return np.asarray(turned)


def rotation_to_up(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] the shortest turn that takes the direction `up` to where ours is, -y."""
    unit = up / np.linalg.norm(up)
    axis = np.cross(unit, _UP)
    if np.linalg.norm(axis) < 1e-12:
        return np.eye(3) if unit @ _UP > 0 else rotation_about(np.array([1.0, 0, 0]), 180)
    return rotation_about(axis, np.rad2deg(np.arctan2(np.linalg.norm(axis), unit @ _UP)))


def _product(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] what multiplies a quaternion w, x, y, z by q from the left."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _sh_turns(rotation: NDArray[np.float64], splats: Splats) -> NDArray[np.float64]:
    """[K, K] what takes coefficients to those of the turned function, band by band.

    The turned function at a direction d is the old one at rotation.T @ d. Each band keeps to
    itself, so the values at more directions than it has coefficients determine it; the basis is the
    rasteriser's own, and its signs and order need not be stated again.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    there = sh_basis(torch.from_numpy(directions), splats.sh_degree).numpy()
    before = sh_basis(torch.from_numpy(directions @ rotation), splats.sh_degree).numpy()
    found = np.zeros((there.shape[1], there.shape[1]))
    for degree in range(splats.sh_degree + 1):
        band = slice(degree * degree, (degree + 1) ** 2)
        found[band, band] = np.linalg.lstsq(there[:, band], before[:, band], rcond=None)[0]
    return found
