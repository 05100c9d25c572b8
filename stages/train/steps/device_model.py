"""A model that stays on a device. What reads a column gets a copy of it on the host; rows that are
taken or joined are numbers of rows until the training step gathers them.

Rules that look at every splat and every camera are computed there: Morton order, distances from the
cameras, widths of the smoothing filter, free space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.raster.definition import LOG_SCALE, MEAN, OPACITY, ROTATION, SH
from stages.raster.smoothing import RIM, VARIANCE
from stages.scene import Camera, morton
from stages.train.free_space import ENOUGH_VIEWS_PAST, FAR, MIN_VIEWS_PAST, NEAR, FreeSpace
from stages.train.optimiser import LEAST_DISTANCE, Model

if TYPE_CHECKING:
    from stages.raster.gpu.rasteriser import DeviceScene, GpuRasteriser  # loads Triton

FIELDS = tuple(field.name for field in fields(Model))
# what can be given in place of what is held; `Held.gathered` takes no other
GIVEN = frozenset(FIELDS) - {"sh", "moment1", "moment2"}
PLACES: dict[str, slice | int] = {
    "means": slice(MEAN, ROTATION),
    "quaternions": slice(ROTATION, LOG_SCALE),
    "log_scales": slice(LOG_SCALE, OPACITY),
    "opacity_logits": OPACITY,
}
# what a splat that was made by a split begins with
NEW = {"distances": 1} | dict.fromkeys(
    ("moment1", "moment2", "steps", "gradient_sum", "gradient_count", "smoothing"), 0
)


class Held(Protocol):
    """A model's numbers on a device. device: of the tensors that `column` gives."""

    @property
    def device(self) -> torch.device: ...
    @property
    def coefficients(self) -> int: ...
    def __len__(self) -> int: ...

    def column(self, name: str) -> Tensor:
        """A field of `Model`, not to be written to; SH coefficients are [N, 3 coefficients]."""

    def finite(self) -> Tensor:
        """[N] bool: see `Model.finite`."""

    def reset_moment2(self) -> None:
        """Set the second moment of every row to 0."""

    def gathered(self, model: DeviceModel) -> Held:
        """The numbers of the model's rows alone."""

    def on_host(self) -> Held:
        """One whose columns are on the host."""


@dataclass
class TensorsHeld:
    """See `Held`. scene: the parameters; others: the remaining fields of `Model`, by name."""

    scene: DeviceScene
    others: dict[str, Tensor]

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def device(self) -> torch.device:
        """See `Held`."""
        return self.scene.rows.device

    @property
    def coefficients(self) -> int:
        """See `Held`."""
        return self.scene.coefficients

    def column(self, name: str) -> Tensor:
        """See `Held`; parameters are views of the rows."""
        if name in self.others:
            return self.others[name]
        rows, used = self.scene.rows, self.scene.layout[1]
        return rows[:, SH:used] if name == "sh" else rows[:, PLACES[name]]

    def finite(self) -> Tensor:
        """See `Held`."""
        return self.scene.rows.isfinite().all(1)

    def reset_moment2(self) -> None:
        """See `Held`."""
        self.others["moment2"].zero_()

    def gathered(self, model: DeviceModel) -> TensorsHeld:
        """See `Held`."""
        rows = self.scene.rows
        rows = rows.clone() if model.index is None else rows[model.index]
        for name, place in PLACES.items():
            if name in model.given:
                rows[:, place] = model.given[name]
        others = {name: model.column(name) for name in self.others}
        return TensorsHeld(replace(self.scene, rows=rows), others)

    def on_host(self) -> TensorsHeld:
        """See `Held`."""
        scene = replace(self.scene, rows=self.scene.rows.cpu())
        return TensorsHeld(scene, {name: tensor.cpu() for name, tensor in self.others.items()})

    def release(self) -> None:
        """Free the memory, whoever still has this."""
        self.scene, self.others = replace(self.scene, rows=self.scene.rows[:0].clone()), {}


def held_of(model: Model, rasteriser: GpuRasteriser) -> TensorsHeld:
    """A model on the host, sent to the rasteriser's device."""
    arrays = {name: vars(model)[name] for name in FIELDS[len(model.arrays) :]}
    others = {name: torch.tensor(array, device=rasteriser.device) for name, array in arrays.items()}
    return TensorsHeld(rasteriser.scene(model.arrays), others)


class DeviceModel(Model):
    """Rows of `held`; good until the next step.

    Args:
        held: of the training step.
        index: [N] numbers of rows, None for all in their order.
        new: [N] bool, splats with a new optimiser state, None for no splat.
        given: columns [N, ...] in place of those held, by name.
    """

    held: Held
    index: Tensor | None
    new: Tensor | None
    given: dict[str, Tensor]

    def __init__(
        self,
        held: Held,
        index: Tensor | None = None,
        new: Tensor | None = None,
        given: dict[str, Tensor] | None = None,
    ) -> None:
        vars(self).update(held=held, index=index, new=new, given=given or {})

    def __len__(self) -> int:
        return len(self.held if self.index is None else self.index)

    def __getattr__(self, name: str) -> Any:
        """A copy of a field on the host, which cannot be written to."""
        if name not in FIELDS:
            raise AttributeError(name)
        found = self._on_host(name)
        found.setflags(write=False)
        vars(self)[name] = found
        return found

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in GIVEN:
            raise AttributeError(f"{name} of a model on a device cannot be replaced")
        self.given[name] = torch.as_tensor(value, device=self.held.device)
        vars(self).pop(name, None)

    def _on_host(self, name: str) -> NDArray[Any]:
        found = self.column(name)
        if name == "sh":
            found = found.reshape(len(self), self.held.coefficients, 3)
        host: NDArray[Any] = found.to("cpu", copy=True).contiguous().numpy()
        return host

    def column(self, name: str) -> Tensor:
        """A field on the device."""
        if name in self.given:
            return self.given[name]
        found = self.held.column(name)
        if self.index is not None:
            found = found[self.index]
        if self.new is not None and name in NEW:
            found = found.clone()
            found[self.new] = NEW[name]
        return found

    def gathered(self) -> Held:
        """The numbers of these rows alone; those held if these are the rows."""
        return self.held if self.index is None and not self.given else self.held.gathered(self)

    def on_host(self) -> Model:
        """See `Model.on_host`. Needs no memory of the device: rows are gathered on the host."""
        index, new = (None if t is None else t.cpu() for t in (self.index, self.new))
        given = {name: column.cpu() for name, column in self.given.items()}
        there = DeviceModel(self.held.on_host(), index, new, given)
        return Model(*(there._on_host(name) for name in FIELDS))

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> Model:
        """See `Model.take`."""
        rows = np.flatnonzero(index) if index.dtype == bool else index
        return self._taken(torch.as_tensor(rows, dtype=torch.int64, device=self.held.device))

    def _taken(self, rows: Tensor) -> DeviceModel:
        index = rows if self.index is None else self.index[rows]
        new = None if self.new is None else self.new[rows]
        given = {name: column[rows] for name, column in self.given.items()}
        return DeviceModel(self.held, index, new, given)

    def joined(self, other: Model) -> Model:
        """See `Model.joined`; of two models of the same step."""
        assert isinstance(other, DeviceModel)
        assert other.held is self.held
        both, device = (self, other), self.held.device
        index = torch.cat([m._every() for m in both])
        none = [torch.zeros(len(m), dtype=torch.bool, device=device) for m in both]
        new = torch.cat([n if m.new is None else m.new for m, n in zip(both, none, strict=True)])
        names = self.given.keys() | other.given.keys()
        given = {name: torch.cat([m.column(name) for m in both]) for name in names}
        return DeviceModel(self.held, index, new, given)

    def _every(self) -> Tensor:
        """[N] numbers of rows."""
        every = torch.arange(len(self.held), device=self.held.device)
        return every if self.index is None else self.index

    def fresh(self) -> Model:
        """See `Model.fresh`."""
        new = torch.ones(len(self), dtype=torch.bool, device=self.held.device)
        given = {name: column for name, column in self.given.items() if name not in NEW}
        return DeviceModel(self.held, self._every(), new, given)

    def reset_gradients(self) -> None:
        """See `Model.reset_gradients`."""
        for name in ("gradient_sum", "gradient_count"):
            setattr(self, name, torch.zeros_like(self.column(name)))

    def reset_moment2(self) -> None:
        """See `Model.reset_moment2`. In place, because a second copy may not fit: models of other
        rows of the same step change, too."""
        self.held.reset_moment2()
        vars(self).pop("moment2", None)

    def finite(self) -> NDArray[np.bool_]:
        """See `Model.finite`."""
        good = self.held.finite()
        good = good if self.index is None else good[self.index]
        for name in self.given.keys() & PLACES.keys():
            good = good & self.given[name].reshape(len(self), -1).isfinite().all(1)
        return np.asarray(good.cpu().numpy())

    def in_morton_order(self) -> Model:
        """See `Model.in_morton_order`."""
        return self._taken(morton_order(self.column("means")))

    def camera_distances(self, cameras: Sequence[Camera], extent: float) -> Any:
        """See `Model.camera_distances`; on the device."""
        means = self.column("means").double()
        found = torch.full_like(means[:, 0], torch.inf)
        for camera in cameras:
            centre = torch.tensor(camera.centre, device=self.held.device)
            found = torch.minimum(found, (means - centre).square().sum(1))
        found = torch.where(found.isfinite(), found.sqrt() / extent, 1.0)
        return found.clamp(min=LEAST_DISTANCE).float()

    def smoothing_widths(self, cameras: Sequence[Camera], near: float) -> Any:
        """See `Model.smoothing_widths`; on the device."""
        means = self.column("means").double()
        finest = torch.full_like(means[:, 0], torch.inf)
        for camera in cameras:
            x, y, z = projected(camera, means)
            beside_x = (x - camera.width / 2).abs() < (0.5 + RIM) * camera.width
            seen = beside_x & ((y - camera.height / 2).abs() < (0.5 + RIM) * camera.height)
            interval = torch.where(seen & (z > near), z / max(camera.fx, camera.fy), torch.inf)
            finest = torch.minimum(finest, interval)
        known = finest.isfinite()
        largest = torch.where(known, finest, 0.0).amax() if len(finest) else 0.0
        return (VARIANCE**0.5 * torch.where(known, finest, largest)).float()

    def in_free_space(self, space: FreeSpace) -> NDArray[np.bool_]:
        """See `Model.in_free_space`."""
        means = self.column("means").double()
        past = torch.zeros(len(means), dtype=torch.int32, device=self.held.device)
        for camera, depths in zip(space.cameras, space.depths, strict=True):
            x, y, z = projected(camera, means)
            seen = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            column, row = (torch.where(seen, c, 0.0).long() for c in (x, y))
            relative = z / torch.tensor(depths, device=self.held.device)[row, column]
            in_front, seen = relative < NEAR, seen & (relative > 0)
            past += (seen & in_front).int()
            past += ENOUGH_VIEWS_PAST * (seen & ~in_front & (relative <= FAR)).int()
        return np.asarray(((past >= MIN_VIEWS_PAST) & (past < ENOUGH_VIEWS_PAST)).cpu().numpy())


def projected(camera: Camera, means: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(pixels x, y and depth z [N]) of means [N, 3] float64: see `Camera.project`."""
    pose = torch.tensor(camera.world_to_camera, dtype=torch.float64, device=means.device)
    at = means @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = at.unbind(1)
    return x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy, z


def morton_order(means: Tensor) -> Tensor:
    """[N] rows of means [N, 3]: see `morton.morton_order_of`."""
    code = torch.zeros(len(means), dtype=torch.int64, device=means.device)
    for axis in range(3):
        distinct, rank = torch.unique(means[:, axis], return_inverse=True)
        bits = rank * ((1 << morton.BITS) - 1) // max(1, len(distinct) - 1)
        for shift, mask in morton.SPREADS:
            bits = (bits | (bits << shift)) & mask
        code |= bits << (2 - axis)
    return torch.argsort(code, stable=True)
