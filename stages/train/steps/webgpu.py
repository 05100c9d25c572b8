"""A training step on a WebGPU device: model, moments, photographs and statistics stay there.

A step does not wait for the device. What the host needs from a step (its loss, and whether its
intersection lists had enough room) arrives LAG steps later. A step whose lists had too little room
leaves the model as it was, and the lists are enlarged once the host knows.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import MemoryFull, RasterSettings, gradient_columns
from stages.raster.webgpu.device import Buffers, Kernel, errors_explained
from stages.raster.webgpu.rasteriser import DeviceScene, DeviceView, Drawn, WebGpuRasteriser
from stages.scene import IGNORE, Camera
from stages.train.dropout import Dropout
from stages.train.optimiser import Model, active_counts, empty_model
from stages.train.steps.device_model import DeviceModel
from stages.train.steps.step import StepInput
from stages.train.steps.webgpu_loss import Loss, loss_of, photograph_of
from stages.train.steps.webgpu_model import CONSTANTS, FILE, WebGpuHeld, webgpu_held_of
from stages.train.views import Level

LAG = 8  # steps after which the host reads the results of a step
SPARE = 1.5  # room for the lists, relative to the largest number so far
_MOVE, _SQUARES, _SIGNS, _MOST, _DROP = (
    Kernel(FILE, entry, CONSTANTS)
    for entry in ("move_splats", "average_squares", "sign_picture", "largest_count", "drop_out")
)


class WebGpuStep:
    """See `step.TrainingStep`."""

    def __init__(self, rasteriser: WebGpuRasteriser, lag: int = LAG) -> None:
        self.rasteriser, self.gpu, self.lag = rasteriser, rasteriser.device, lag
        self._buffers = Buffers(self.gpu)
        self._loss = Loss(self._buffers)
        self._room, self._skipped = 0, 0
        self._arrivals: deque[Callable[[], tuple[float, int]]] = deque()
        self._photographs: dict[int, tuple[Level, Any]] = {}
        self.load(empty_model())

    def __len__(self) -> int:
        return len(self._held if self._on_host is None else self._on_host)

    @property
    def skipped(self) -> int:
        """See `step.TrainingStep`; waits for the device."""
        with errors_explained(len(self)):
            for arrival in self._arrivals:
                arrival()
        return self._skipped

    def load(self, model: Model) -> None:
        """See `step.TrainingStep`."""
        self._on_host: Model | None = model  # known even if there is no room for it
        with errors_explained(len(model)):
            if isinstance(model, DeviceModel):
                held = model.gathered()
                assert isinstance(held, WebGpuHeld)
                self._held: WebGpuHeld = held
                self._on_host = None
            else:
                self._held = webgpu_held_of(model, self.rasteriser)

    def model(self) -> Model:
        """See `step.TrainingStep`."""
        return DeviceModel(self._held) if self._on_host is None else self._on_host

    def forget_views(self) -> None:
        """See `step.TrainingStep`."""
        self._photographs.clear()

    def step(self, given: StepInput) -> float:
        """See `step.TrainingStep`; the loss is that of LAG steps ago."""
        try:
            with errors_explained(len(self)):
                self._step(given)
        except MemoryFull:
            if not self._photographs:
                raise
            self._photographs.clear()  # they are sent again one by one
            with errors_explained(len(self)):
                self._step(given)
        with errors_explained(len(self)):
            late = self._arrivals.popleft() if len(self._arrivals) > self.lag else None
            return (late or self._arrivals[-1])()[0]

    def _step(self, given: StepInput) -> None:
        level, settings, gpu = given.level, given.settings, self.gpu
        known = id(level.means) in self._photographs
        photograph = self._photograph(level)
        scene = self._scene(given.smooth, given.dropout)
        view = self.rasteriser.view(level.camera, settings)
        drawn = self.rasteriser.draw(scene, view, capacity=self._room if known else None)
        room = drawn.lists.capacity
        if not known:  # the first step on a view waits for the device
            self._room = max(self._room, int(SPARE * room))
        v_image = self._loss.gradient(
            drawn.image, photograph, level, settings.background, given.weight
        )
        if given.sign_key is not None:
            signs = self._signs(photograph, level, given.sign_key, given.weight)
            derivatives, _ = self.rasteriser.gradients(scene, view, drawn, signs)
            self._measure(drawn, view, given.rates.extent, derivatives)
        gradients, means2d = self.rasteriser.gradients(scene, view, drawn, v_image)
        self._move(drawn, view, given, gradients, means2d)
        self._held.moved()
        self._on_host = None
        gpu.copy(drawn.lists.ends, self._loss.sums, 1, (len(scene), 5))
        self._arrivals.append(self._arrival(room))

    def _arrival(self, room: int) -> Callable[[], tuple[float, int]]:
        sent = self.gpu.read_later(self._loss.sums, np.float32, 6)

        @functools.cache
        def arrived() -> tuple[float, int]:
            sums = sent()
            wanted = int(sums[5:].view(np.uint32)[0])
            self._skipped += wanted > room
            if wanted > self._room:
                self._room = int(SPARE * wanted)
            return loss_of(sums), wanted

        return arrived

    def draw(self, camera: Camera, settings: RasterSettings, smooth: bool) -> NDArray[np.float32]:
        """See `step.TrainingStep`."""
        with errors_explained(len(self)):
            view = self.rasteriser.view(camera, settings)
            image = self.rasteriser.draw(self._scene(smooth), view).image
            planes = self.gpu.read(image, np.float32, 3 * camera.width * camera.height)
        planes = planes.reshape(3, camera.height, camera.width)
        return np.ascontiguousarray(planes.transpose(1, 2, 0))

    def _photograph(self, level: Level) -> Any:
        key = id(level.means)  # the same object each time that a level is read
        if key not in self._photographs:
            self._photographs[key] = level, photograph_of(level, self.gpu)
        return self._photographs[key][1]

    def _scene(self, smooth: bool, dropout: Dropout | None = None) -> DeviceScene:
        scene, state = self._held.scene, self._held.state
        scene = scene if smooth else replace(scene, smoothing=None)
        n, columns = len(scene), scene.columns
        if dropout is None or not n:
            return scene
        rows, most = self._buffers.get("dropped", n * columns), self._buffers.get("most", 1)
        given = (n, columns, dropout.key, float(dropout.views))
        self.gpu.copy(scene.rows, rows, n * columns)
        self.gpu.run(_MOST, 1, (state, most), given)
        self.gpu.run(_DROP, -(-n // 256), (state, most, rows), given)
        return replace(scene, rows=rows)

    def _move(
        self, drawn: Drawn, view: DeviceView, given: StepInput, gradients: Any, means2d: Any
    ) -> None:
        scene, rates, n = self._held.scene, given.rates, len(self._held)
        numbers = (
            *self._sizes(drawn, view, rates.extent),
            *(0.5 * view.width / view.pixels, 0.5 * view.height / view.pixels),
            *map(float, (rates.means, rates.quaternions, rates.log_scales, rates.opacity_logits)),
            *map(float, (rates.sh_dc, rates.sh_rest)),
            float(given.damping),
        )
        buffers = (gradients, means2d, drawn.keys, drawn.lists.ends, scene.rows)
        self.gpu.run(_MOVE, -(-n // 16), (*buffers, *self._held.moments, self._held.state), numbers)

    def _signs(self, photograph: Any, level: Level, key: int, weight: float) -> Any:
        """[3, H, W] in a buffer, until the next one: see `gauss_newton.sign_picture`."""
        _, height, width = level.pixels.shape
        signs = self._buffers.get("signs", 3 * width * height)
        given = (width * height, int(level.outside == IGNORE), key, weight**0.5)
        self.gpu.run(_SIGNS, -(-3 * width * height // 256), (photograph, signs), given)
        return signs

    def _measure(self, drawn: Drawn, view: DeviceView, extent: float, derivatives: Any) -> None:
        """Average the squares of the derivatives into moment2."""
        buffers = (derivatives, None, drawn.keys, drawn.lists.ends, None, None)
        curvature, n = self._held.moments[1], len(self._held)
        numbers = (*self._sizes(drawn, view, extent), *[0.0] * 9)
        self.gpu.run(_SQUARES, -(-n // 16), (*buffers, curvature), numbers)

    def _sizes(
        self, drawn: Drawn, view: DeviceView, extent: float
    ) -> tuple[int, int, int, int, int, float]:
        """What `Step` in optimiser.wgsl begins with."""
        scene, coefficients = self._held.scene, view.coefficients(self._held.scene)
        return (
            *(len(scene), scene.columns, gradient_columns(coefficients)),
            *(active_counts(coefficients), drawn.lists.capacity, float(extent)),
        )
