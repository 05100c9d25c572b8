"""Refines the cameras of training views while splats are trained on them: a pose for each view, and
one factor of the focal lengths for all.

A camera that moves changes its picture as splats do that move the other way. So its gradient is a
sum over the gradients of the splats, and no rasteriser has to know of it:

- translation: the gradients by the means;
- rotation about the camera's centre: the torques of the gradients by means and by quaternions;
- focal length: where it grows by a share, everything comes nearer by that share along the axis.

Two terms are left out: a rotation does not change the view-dependent part of the colour, and a
focal length does not change the thickness of splats along the optical axis. The parameters are
optimised by Adam (Kingma and Ba 2015) with step sizes that decay exponentially.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.raster.definition import LOG_SCALE, MEAN, ROTATION, Backward
from stages.scene import Camera, RefinedCameras
from stages.train.optimiser import Model

# Of one step of Adam: radians, extents of the scene, and shares of the focal length.
RATE, FOCAL_RATE, RATE_END = 1e-3, 3e-4, 1e-3
STARTS = 0.05  # share of the run: before, the splats know less than the cameras
_BETA1, _BETA2, _TINY = 0.9, 0.99, 1e-12
# 0.5 e x q is the derivative of the quaternion q (w, x, y, z) by a rotation about the unit vector e
_LEFT = 0.5 * np.array(
    [
        [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]],
        [[0, 0, -1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, -1, 0, 0]],
        [[0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0]],
    ]
)


@dataclass
class CameraRefinement:
    """The cameras of V views, and the state of their optimiser.

    Args:
        names: of the views.
        extent: of the scene, world units.
        first: [V, 4, 4] world_to_camera at the start.
        poses: [V, 4, 4] now.
        moments: [V, 2, 6] first and second moments of the gradients by rotation (radians) and
            translation (extents), in the frame of the camera.
        counts: [V] steps of each.
        focal_factor: of all focal lengths.
        focal_moments: [2] of the gradient by the logarithm of that factor.
    """

    names: Sequence[str]
    extent: float
    first: NDArray[np.float64]
    poses: NDArray[np.float64]
    moments: NDArray[np.float64]
    counts: NDArray[np.int64]
    focal_factor: float = 1.0
    focal_moments: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))

    @classmethod
    def of(cls, cameras: Mapping[str, Camera], extent: float) -> CameraRefinement:
        """That starts from `cameras`, by name. extent: of the scene, world units."""
        names, poses = list(cameras), np.array([c.world_to_camera for c in cameras.values()])
        moments, counts = np.zeros((len(poses), 2, 6)), np.zeros(len(poses), np.int64)
        return cls(names, extent, poses, poses.copy(), moments, counts)

    @property
    def result(self) -> RefinedCameras:
        poses = dict(zip(self.names, self.poses.copy(), strict=True))
        return RefinedCameras(poses, self.focal_factor)

    @property
    def changes(self) -> tuple[float, float]:
        """By how much cameras have moved (world units) and turned (degrees): medians."""
        pairs = [[np.linalg.inv(pose) for pose in poses] for poses in (self.first, self.poses)]
        before, now = np.array(pairs)
        turned = Rotation.from_matrix(before[:, :3, :3].transpose(0, 2, 1) @ now[:, :3, :3])
        moved = np.linalg.norm(now[:, :3, 3] - before[:, :3, 3], axis=1)
        return float(np.median(moved)), float(np.degrees(np.median(turned.magnitude())))

    def camera(self, row: int, camera: Camera) -> Camera:
        """The refined camera of view `row`. camera: as it was before."""
        fx, fy = camera.fx * self.focal_factor, camera.fy * self.focal_factor
        return replace(camera, fx=fx, fy=fy, world_to_camera=self.poses[row].copy())

    def update(
        self, row: int, share: float, model: Model, backward: Backward, with_lens: bool = True
    ) -> None:
        """One step of Adam for view `row`.

        Args:
            row: of the view.
            share: of the run that is done, 0 to 1.
            model: that was drawn.
            backward: gradients of the loss by the splats, in the view's present camera.
            with_lens: whether the focal lengths are refined as well.
        """
        if share < STARTS:
            return
        gradient, focal = camera_gradients(self.poses[row], model, backward)
        gradient[3:] *= self.extent
        decay = RATE_END**share
        self.counts[row] += 1
        step = RATE * decay * _adam(self.moments[row], gradient, int(self.counts[row]))
        move = np.eye(4)
        move[:3, :3] = Rotation.from_rotvec(-step[:3]).as_matrix()
        move[:3, 3] = -step[3:] * self.extent
        self.poses[row] = move @ self.poses[row]
        if not with_lens:
            return
        change = _adam(self.focal_moments, np.float64(focal), int(self.counts.sum()))
        self.focal_factor *= float(np.exp(-FOCAL_RATE * decay * change))

    def state(self) -> dict[str, object]:
        """Plain data for a checkpoint."""
        arrays = ("poses", "moments", "counts", "focal_moments")
        kept: dict[str, object] = {name: getattr(self, name).tolist() for name in arrays}
        return kept | {"focal_factor": self.focal_factor}

    def load(self, state: dict[str, object]) -> None:
        """Go on from what `state` gave."""
        for name, value in state.items():
            now = getattr(self, name)
            setattr(self, name, value if isinstance(now, float) else np.array(value, now.dtype))


def camera_gradients(
    world_to_camera: NDArray[np.float64], model: Model, backward: Backward
) -> tuple[NDArray[np.float64], float]:
    """(by rotation [3] and translation [3] in the frame of the camera, per radian and world unit;
    by the logarithm of the focal length) of the loss whose gradients by the splats are given.

    Args:
        world_to_camera: [4, 4] of the camera.
        model: that was drawn.
        backward: gradients of its visible splats.
    """
    gradients = backward.parameters[:, :LOG_SCALE].astype(np.float64)
    valid = np.isfinite(gradients).all(1)
    rows, gradients = backward.rows[valid], gradients[valid]
    by_mean, by_quaternion = gradients[:, MEAN:ROTATION], gradients[:, ROTATION:]
    rotation = world_to_camera[:3, :3]
    from_camera = model.means[rows] + (rotation.T * world_to_camera[:3, 3]).sum(1)
    torque = np.cross(from_camera, by_mean).sum(0)
    moved = np.einsum("kij,nj->nki", _LEFT, model.quaternions[rows].astype(np.float64))
    torque += (moved * by_quaternion[:, None]).sum((0, 2))
    pose = np.concatenate([(rotation * torque).sum(1), (rotation * by_mean.sum(0)).sum(1)])
    forward = rotation[2]
    focal = -float(((from_camera * forward).sum(1) * (by_mean * forward).sum(1)).sum())
    return pose, focal


def _adam(
    moments: NDArray[np.float64], gradient: NDArray[np.float64] | np.float64, count: int
) -> NDArray[np.float64]:
    """The direction of Adam's step number `count`, about 1; updates both moments."""
    moments[0] = _BETA1 * moments[0] + (1 - _BETA1) * gradient
    moments[1] = _BETA2 * moments[1] + (1 - _BETA2) * gradient**2
    first = moments[0] / (1 - _BETA1**count)
    second = moments[1] / (1 - _BETA2**count)
    return np.asarray(first / (np.sqrt(second) + _TINY))
