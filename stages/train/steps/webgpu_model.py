"""A model on a WebGPU device. A column is read from there when a rule asks for it; rows that a rule
takes are gathered there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.raster.definition import LOG_SCALE, MEAN, OPACITY, ROTATION, SH, SH_REST, used_columns
from stages.raster.webgpu.device import Device, Kernel, errors_explained
from stages.raster.webgpu.rasteriser import DeviceScene, WebGpuRasteriser
from stages.train import dropout, gauss_newton, optimiser
from stages.train.optimiser import STEP_COUNTS, Model
from stages.train.random_bits import FACTORS, INCREMENT
from stages.train.steps.device_model import DeviceModel

NEW = 1 << 31
# Columns of the rows of `WebGpuHeld.state`, 32 bits each: the counts of steps, and these.
GRADIENT_COUNT, GRADIENT_SUM, DISTANCE, SH_DEGREE, STATE = range(STEP_COUNTS, STEP_COUNTS + 5)
# Fields of `Model` by where they are: buffer, first column, width, type.
_PARAMETERS: dict[str, tuple[str, int, int, Any]] = {
    "means": ("rows", MEAN, 3, np.float32),
    "quaternions": ("rows", ROTATION, 4, np.float32),
    "log_scales": ("rows", LOG_SCALE, 3, np.float32),
    "opacity_logits": ("rows", OPACITY, 1, np.float32),
}
_STATE: dict[str, tuple[str, int, int, Any]] = {
    "steps": ("state", 0, STEP_COUNTS, np.int32),
    "gradient_count": ("state", GRADIENT_COUNT, 1, np.int32),
    "gradient_sum": ("state", GRADIENT_SUM, 1, np.float32),
    "distances": ("state", DISTANCE, 1, np.float32),
    "sh_degrees": ("state", SH_DEGREE, 1, np.uint32),
}
_FLAT = frozenset(name for name, place in (_PARAMETERS | _STATE).items() if place[2] == 1)
FILE = Path(__file__).parent / "wgsl" / "optimiser.wgsl"
CONSTANTS: tuple[tuple[str, float], ...] = (
    *(("NEW", NEW), ("STATE", STATE), ("GRADIENT_COUNT", GRADIENT_COUNT)),
    *(("GRADIENT_SUM", GRADIENT_SUM), ("DISTANCE", DISTANCE), ("SH_DEGREE", SH_DEGREE)),
    *((name, getattr(optimiser, name)) for name in ("BETA1", "BETA2", "EPSILON")),
    *(("LOG_BETA1", float(np.log(optimiser.BETA1))), ("LOG_BETA2", float(np.log(optimiser.BETA2)))),
    *(("LARGEST_GRADIENT", optimiser.LARGEST_GRADIENT), ("SH_REST", SH_REST)),
    *(("DEGREE_2", used_columns(4)), ("DEGREE_3", used_columns(9))),
    *((name, getattr(dropout, name)) for name in ("VIEW_SCALE", "MAX_PROBABILITY")),
    *((name, getattr(dropout, name)) for name in ("NEIGHBOURHOOD", "INVISIBLE")),
    ("CURVATURE_DECAY", gauss_newton.CURVATURE_DECAY),
    *(("INCREMENT", INCREMENT), ("SHIFT_1", FACTORS[0][0]), ("FACTOR_1", FACTORS[0][1])),
    *(("SHIFT_2", FACTORS[1][0]), ("FACTOR_2", FACTORS[1][1])),
)
_COPY = Kernel(FILE, "copy_rows", CONSTANTS)


class WebGpuHeld:
    """See `device_model.Held`. gpu: the device; scene: parameters and widths of the smoothing
    filter; moments [N, columns of the scene's rows]; state [N, STATE]."""

    device = torch.device("cpu")  # of what `column` gives

    def __init__(
        self, gpu: Device, scene: DeviceScene, moments: tuple[Any, Any], state: Any
    ) -> None:
        self.gpu, self.scene, self.moments, self.state = gpu, scene, moments, state
        self._read: dict[str, Tensor] = {}

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def coefficients(self) -> int:
        """See `device_model.Held`."""
        return self.scene.coefficients

    def moved(self) -> None:
        """Forget what was read, because a step changes it."""
        self._read.clear()

    def column(self, name: str) -> Tensor:
        """See `device_model.Held`; on the host."""
        if name not in self._read:
            with errors_explained(len(self)):
                self._read[name] = torch.from_numpy(self._column(name))
        return self._read[name]

    def _column(self, name: str) -> NDArray[Any]:
        gpu, n, columns = self.gpu, len(self), self.scene.columns
        whole = {"moment1": self.moments[0], "moment2": self.moments[1], "rows": self.scene.rows}
        if name in whole:
            return gpu.read(whole[name], np.float32, n * columns).reshape(n, columns)
        if name == "smoothing":
            return gpu.read(self.scene.smoothing, np.float32, n)
        sh = ("rows", SH, 3 * self.coefficients, np.float32)
        where, first, width, dtype = (_PARAMETERS | _STATE | {"sh": sh})[name]
        source = (self.scene.rows, columns) if where == "rows" else (self.state, STATE)
        compact = gpu.empty(n * width)
        _copy(gpu, n, width, (*source, first), (compact, width, 0))
        found = gpu.read(compact, dtype, n * width)
        if name == "sh_degrees":
            found = found.astype(np.uint8)
        return found if name in _FLAT else found.reshape(n, width)

    def finite(self) -> Tensor:
        """See `device_model.Held`."""
        return self.column("rows").isfinite().all(1)

    def reset_moment2(self) -> None:
        """See `device_model.Held`."""
        self.gpu.clear(self.moments[1], len(self) * self.scene.columns)
        self._read.pop("moment2", None)

    def gathered(self, model: DeviceModel) -> WebGpuHeld:
        """See `device_model.Held`."""
        gpu, n, columns = self.gpu, len(model), self.scene.columns
        index = torch.arange(n) if model.index is None else model.index
        marked = index if model.new is None else index + NEW * model.new.long()
        numbers = gpu.sent(marked.numpy().astype(np.uint32))
        made = []
        for source, fresh in zip(
            (self.scene.rows, *self.moments), (False, True, True), strict=True
        ):
            made.append(gpu.empty(n * columns))
            _copy(gpu, n, columns, (source, columns, 0), (made[-1], columns, 0), numbers, fresh)
        for name, (_, first, width, _) in _PARAMETERS.items():
            if name in model.given:
                values = gpu.sent(model.given[name].numpy())
                _copy(gpu, n, width, (values, width, 0), (made[0], columns, first))
        widths = gpu.sent(model.column("smoothing").numpy())
        scene = DeviceScene(made[0], n, self.coefficients, widths)
        return WebGpuHeld(gpu, scene, (made[1], made[2]), gpu.sent(_state(model.column)))

    def on_host(self) -> WebGpuHeld:
        """See `device_model.Held`: columns are there."""
        return self


def webgpu_held_of(model: Model, rasteriser: WebGpuRasteriser) -> WebGpuHeld:
    """A model on the host, sent to the rasteriser's device."""
    gpu = rasteriser.device
    scene = rasteriser.scene((*model.arrays, model.smoothing))
    state = _state(lambda name: getattr(model, name))
    return WebGpuHeld(
        gpu, scene, (gpu.sent(model.moment1), gpu.sent(model.moment2)), gpu.sent(state)
    )


def _state(column: Any) -> NDArray[np.uint32]:
    """[N, STATE] from the fields that `column` gives."""
    parts = []
    for name, (_, _, width, dtype) in _STATE.items():
        values = np.ascontiguousarray(np.asarray(column(name)).astype(dtype))
        parts.append(values.reshape(-1, width).view(np.uint32))
    return np.concatenate(parts, 1)


def _copy(
    gpu: Device,
    n: int,
    width: int,
    source: tuple[Any, int, int],
    to: tuple[Any, int, int],
    numbers: Any = None,
    fresh: bool = False,
) -> None:
    """Record a copy of n rows' columns. source, to: buffer, columns of a row, first column."""
    numbered = int(numbers is not None)
    rows = (source[0], numbers if numbered else source[0], to[0])
    gpu.run(_COPY, -(-n // 16), rows, (n, width, *source[1:], *to[1:], numbered, int(fresh)))
