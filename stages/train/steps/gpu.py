"""A training step on the GPU: model, moments, views and statistics stay there.

A step does not wait for the device. What the host needs from a step (its loss, and whether its
intersection lists had enough room) arrives LAG steps later. A step whose lists had too little room
leaves the model as it was, and the lists are enlarged once the host knows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
import triton
from numpy.typing import NDArray
from torch import Tensor

from stages.raster.definition import OPACITY, ROTATION, SH, RasterSettings, gradient_columns
from stages.raster.gpu.device import gpu_errors_explained, interpreted
from stages.raster.gpu.rasteriser import DeviceScene, DeviceView, Drawn, GpuRasteriser
from stages.scene import IGNORE, Camera
from stages.train.dropout import (
    INVISIBLE,
    MAX_PROBABILITY,
    NEIGHBOURHOOD,
    VIEW_SCALE,
    Dropout,
)
from stages.train.loss import SSIM_WEIGHT
from stages.train.optimiser import (
    Model,
    active_counts,
    bias_corrections,
    empty_model,
)
from stages.train.random_bits import FACTORS, INCREMENT
from stages.train.steps import gpu_kernels
from stages.train.steps.device_model import DeviceModel, TensorsHeld, held_of
from stages.train.steps.step import StepInput
from stages.train.views import Colour, Level, evened

Result = TypeVar("Result")

LAG = 8  # steps after which the host reads the results of a step
SPARE = 1.5  # room for the lists, relative to the largest number so far
_LOW = 0xFFFFFFFF  # products are computed in 64-bit integers, which hold what 32-bit ones overflow


class Arrivals:
    """Pairs of numbers that are copied from the device to the host and read `lag` steps later."""

    def __init__(self, device: torch.device, lag: int) -> None:
        self.lag, self.sent = lag, 0
        self.on_device = device.type == "cuda"
        self._landing = torch.zeros(lag + 1, 2, dtype=torch.float64, pin_memory=self.on_device)
        self._numbers = self._landing.numpy()
        self._events: list[Any] = [None] * (lag + 1)

    def send(self, pair: Tensor) -> None:
        """Start a copy of a pair [2]."""
        slot = self.sent % (self.lag + 1)
        self._landing[slot].copy_(pair, non_blocking=True)
        if self.on_device:
            self._events[slot] = torch.cuda.current_stream().record_event()
        self.sent += 1

    def read(self) -> tuple[float, float]:
        """The pair sent `lag` steps ago; at first, the newest one, which is waited for."""
        late = self.lag if self.sent > self.lag else 0
        slot = (self.sent - 1 - late) % (self.lag + 1)
        if self.on_device:
            self._events[slot].synchronize()
        return float(self._numbers[slot, 0]), float(self._numbers[slot, 1])


@dataclass
class GpuTarget:
    """A training view on a device.

    Args:
        level: the view; kept because `GpuStep` identifies views by its means.
        pixels: [3, H, W] bytes, or float32 if the light is corrected or the view is cut out.
        means: [3] of the channels.
        uncovered: [H, W] how much of the background shows in a cut-out view.
        ignored: [H, W] where the render is not compared.
        overexposed: [3, H, W] where the photograph is.
        cameras: on the device, by the settings that they depend on.
    """

    level: Level
    pixels: Tensor
    means: Tensor
    uncovered: Tensor | None = None
    ignored: Tensor | None = None
    overexposed: Tensor | None = None
    cameras: dict[Any, DeviceView] = field(default_factory=dict)

    def view(self, rasteriser: GpuRasteriser, settings: RasterSettings) -> DeviceView:
        """The view's camera, which is sent to the device once for each value of these settings."""
        key = settings.near, settings.dilation_px2, settings.antialias
        if key not in self.cameras:
            self.cameras[key] = rasteriser.view(self.level.camera, settings)
        known = self.cameras[key]
        return DeviceView(known.cam, known.width, known.height, settings)

    def target(self, image: Tensor, background: Colour) -> tuple[Tensor, Tensor]:
        """(the target for `image` [>= 3, H, W], the means of its channels)."""
        if self.level.unchanged:
            return self.pixels, self.means
        target = self.pixels
        if self.overexposed is not None:
            target = torch.where(self.overexposed, torch.maximum(target, image[:3]), target)
        if self.uncovered is not None:
            behind = [self.uncovered * channel for channel in background]
            target = target + torch.stack(behind)
        if self.ignored is not None:
            target = torch.where(self.ignored, image[:3], target)
        return target, target.mean((1, 2))

    def ignore_masked(self, v_image: Tensor) -> None:
        """Set the gradient [3, H, W] to 0 in the view's ignored region."""
        if self.ignored is not None:
            v_image.masked_fill_(self.ignored, 0.0)


def gpu_target_of(level: Level, device: torch.device) -> GpuTarget:
    """The view, on the device."""

    def sent(array: Any) -> Any:
        return None if array is None else torch.tensor(array, device=device)

    if level.unchanged:
        return GpuTarget(level, sent(level.pixels), sent(level.means))
    pixels, overexposed, uncovered = map(sent, evened(level))
    ignores = level.mask is not None and level.outside == IGNORE
    ignored = sent(level.mask == 0) if ignores else None
    return GpuTarget(level, pixels, sent(level.means), uncovered, ignored, overexposed)


class GpuStep:
    """See `step.TrainingStep`."""

    def __init__(self, rasteriser: GpuRasteriser, lag: int | None = None) -> None:
        self.rasteriser, self.device = rasteriser, rasteriser.device
        self._room, self._room_splats, self._splats = 0, 0, 0
        self.skipped = torch.zeros(1, dtype=torch.int64, device=self.device)
        self._arrivals = Arrivals(
            self.device, (0 if interpreted() else LAG) if lag is None else lag
        )
        self._targets: dict[int, GpuTarget] = {}
        self._corrections = self._on_device(bias_corrections())
        self._unsmoothed = torch.zeros(0, device=self.device)
        self._on_host: Model | None = None
        self._held = held_of(empty_model(), rasteriser)
        self.load(empty_model())

    def __len__(self) -> int:
        return self._splats

    def load(self, model: Model) -> None:
        """See `step.TrainingStep`."""
        if len(model):  # the empty model is loaded only to free the device's memory for a moment
            self._room = int(self._room * len(model) / max(1, self._room_splats))
            self._room_splats = len(model)
        self._splats, self._on_host = len(model), model  # known even if there is no room for it
        self._with_memory(lambda: self._load(model))

    def _load(self, model: Model) -> None:
        if isinstance(model, DeviceModel):
            try:
                held, self._on_host = model.gathered(), None
                assert isinstance(held, TensorsHeld)
                self._held = held
            except torch.OutOfMemoryError:
                if self._targets:
                    raise
                # the rows do not fit beside their copies
                model = self._on_host = model.on_host()
        if not isinstance(model, DeviceModel):
            self._held.release()
            self._held = held_of(model, self.rasteriser)
        self._own = self._own_columns()

    def _with_memory(self, work: Callable[[], Result]) -> Result:
        """The result of `work`. If the device's memory is full, it loses its photographs, which are
        sent again one by one as they are needed, and `work` is repeated. Raises MemoryFull."""
        with gpu_errors_explained(len(self)):
            try:
                return work()
            except torch.OutOfMemoryError:
                if not self._targets:
                    raise
            self._targets.clear()  # here, because the error holds what the work had allocated
            return work()

    def model(self) -> Model:
        """See `step.TrainingStep`."""
        return DeviceModel(self._held) if self._on_host is None else self._on_host

    def forget_views(self) -> None:
        """See `step.TrainingStep`."""
        self._targets.clear()

    def step(self, given: StepInput) -> float:
        """See `step.TrainingStep`; the loss is that of LAG steps ago."""
        value, wanted = self._with_memory(lambda: self._step(given))
        if wanted > self._room:
            self._room = int(SPARE * wanted)
        return value

    def _step(self, given: StepInput) -> tuple[float, float]:
        """(the loss, the number of entries of the lists) of LAG steps ago."""
        level, settings = given.level, given.settings
        known = id(level.means) in self._targets
        view_target = self._target(level)
        view = view_target.view(self.rasteriser, settings)
        scene = self._drawn_scene(given.smooth, given.dropout)
        room = self._room if known else None
        drawn = self.rasteriser.draw(scene, view, capacity=room)
        if room is None:  # the first step on this view waits for the device
            room = len(drawn.lists.members)
            self._room = max(self._room, int(SPARE * room))
        target, means = view_target.target(drawn.image, settings.background)
        loss, v_image = image_loss(drawn.image, target, means)
        if given.weight != 1.0:
            v_image *= given.weight
        view_target.ignore_masked(v_image)
        if given.sign_key is not None:
            signs = sign_picture(v_image, given.sign_key, given.weight)
            view_target.ignore_masked(signs)
            derivatives, _ = self.rasteriser.gradients(scene, view, drawn, signs)
            self._measure(drawn, view, derivatives, given.rates.extent, room)
            del signs, derivatives
        parameters, means2d = self.rasteriser.gradients(scene, view, drawn, v_image)
        if self._own is not None:
            parameters *= self._own
        results = torch.stack([loss.double(), drawn.lists.total[0].double()])
        self.skipped += drawn.lists.total > room
        # last, because what needs memory may be repeated
        self._move(drawn, view, parameters, means2d, given, room)
        self._on_host = None
        self._arrivals.send(results)
        return self._arrivals.read()

    def draw(self, camera: Camera, settings: RasterSettings, smooth: bool) -> NDArray[np.float32]:
        """See `step.TrainingStep`."""

        def drawn() -> Tensor:
            view = self.rasteriser.view(camera, settings)
            return self.rasteriser.draw(self._drawn_scene(smooth), view).image

        image = self._with_memory(drawn)
        return np.ascontiguousarray(_host(image[:3]).transpose(1, 2, 0))

    def _drawn_scene(self, smooth: bool, dropout: Dropout | None = None) -> DeviceScene:
        widths = self._held.others["smoothing"] if smooth else self._unsmoothed
        rows, counts = self._held.scene.rows, self._held.others["gradient_count"]
        if dropout is not None:
            rows = rows.clone()
            rows[:, OPACITY].masked_fill_(dropped(dropout, counts), INVISIBLE)
        return DeviceScene(rows, self._held.scene.coefficients, widths)

    def _target(self, level: Level) -> GpuTarget:
        key = id(level.means)  # the same object each time that a level is read
        if key not in self._targets:
            self._targets[key] = gpu_target_of(level, self.device)
        return self._targets[key]

    def _move(
        self,
        drawn: Drawn,
        view: DeviceView,
        parameters: Tensor,
        means2d: Tensor,
        given: StepInput,
        room: int,
    ) -> None:
        rates = given.rates
        scene, held = self._held.scene, self._held.others
        (n, columns), coefficients = scene.rows.shape, view.coefficients(scene)
        if n == 0:
            return
        parameters[:, :ROTATION] *= rates.extent
        block = 4096 if interpreted() else 16
        pixels = view.width * view.height
        gpu_kernels.move_kernel[(triton.cdiv(n, block),)](
            *(scene.rows, held["moment1"], held["moment2"], held["steps"], parameters, means2d),
            *(drawn.keys, held["gradient_sum"], held["gradient_count"], held["distances"]),
            self._corrections,
            *(drawn.lists.total, room, n, gradient_columns(coefficients)),
            *(active_counts(coefficients), rates.means, rates.quaternions, rates.log_scales),
            *(rates.opacity_logits, rates.sh_dc, rates.sh_rest),
            *(0.5 * view.width / pixels, 0.5 * view.height / pixels),
            *(rates.extent, given.damping),
            COLUMNS=columns,
            WIDTH=triton.next_power_of_2(columns),
            BLOCK=block,
            GAUSS_NEWTON=given.damping > 0.0,
        )

    def _measure(
        self, drawn: Drawn, view: DeviceView, derivatives: Tensor, extent: float, room: int
    ) -> None:
        """Average the squares of the derivatives into moment2."""
        (n, columns), coefficients = derivatives.shape, view.coefficients(self._held.scene)
        if n == 0:
            return
        derivatives[:, :ROTATION] *= extent
        block = 4096 if interpreted() else 16
        gpu_kernels.average_squares_kernel[(triton.cdiv(n, block),)](
            *(self._held.others["moment2"], derivatives, drawn.keys, drawn.lists.total, room, n),
            gradient_columns(coefficients),
            COLUMNS=columns,
            WIDTH=triton.next_power_of_2(columns),
            BLOCK=block,
        )

    def _own_columns(self) -> Tensor | None:
        """[N, columns] 0 for SH coefficients above a splat's own degree, else 1; None if every
        splat has all coefficients."""
        columns, used = self._held.scene.layout
        own = SH + 3 * (self._held.others["sh_degrees"].long() + 1) ** 2
        if bool((own >= used).all()):
            return None
        return (torch.arange(columns, device=self.device) < own[:, None]).float()

    def _on_device(self, array: NDArray[Any]) -> Tensor:
        return torch.tensor(array, device=self.device)


def image_loss(
    image: Tensor, target: Tensor, means: Tensor, ssim_weight: float = SSIM_WEIGHT
) -> tuple[Tensor, Tensor]:
    """(loss, a tensor of one number; gradient of H x W x loss [3, H, W]): see `loss.image_loss`.
    target: bytes, or float32 in 0..1; all on one device."""
    _, height, width = target.shape
    like: dict[str, Any] = {"device": image.device}
    block = 4096 if interpreted() else 256
    grid = (triton.cdiv(3 * height * width, block),)
    maps, slopes = (torch.empty(k, 3, height, width, **like) for k in (4, 3))
    filtered, v_image = torch.empty_like(slopes), torch.empty(3, height, width, **like)
    ssim, l1 = torch.empty(grid[0], **like), torch.empty(grid[0], **like)
    size: tuple[Any, ...] = (width, height)
    unit = 1 / 255 if target.dtype == torch.uint8 else 1.0
    gpu_kernels.rows_kernel[grid](image, target, means, unit, maps, *size, BLOCK=block)
    gpu_kernels.similarity_kernel[grid](maps, means, slopes, ssim, *size, BLOCK=block)
    gpu_kernels.slope_rows_kernel[grid](slopes, filtered, *size, BLOCK=block)
    gpu_kernels.loss_gradient_kernel[grid](
        *(image, target, means, unit, filtered, v_image, l1, ssim_weight, *size), BLOCK=block
    )
    count = 3 * height * width
    alike, apart = ssim.double().sum() / count, l1.double().sum() / count
    return (1 - ssim_weight) * apart + ssim_weight * (1 - alike), v_image


def _host(tensor: Tensor) -> NDArray[Any]:
    found: NDArray[Any] = tensor.detach().cpu().numpy().copy()
    return found


def dropped(dropout: Dropout, counts: Tensor) -> Tensor:
    """[N] bool: see `Dropout.dropped`. counts [N] int32."""
    n = len(counts)
    if n == 0:
        return torch.zeros(0, dtype=torch.bool, device=counts.device)
    seen_by = dropout.views * ((counts.double() + 1.0) / (counts.max() + 1.0))
    probability = torch.square(VIEW_SCALE / seen_by.clamp(min=1.0)).clamp(max=MAX_PROBABILITY)
    return _noise(n, dropout.key, counts.device) < probability * 2.0**32


def _noise(n: int, key: int, device: torch.device) -> Tensor:
    return _hashed(torch.arange(n, device=device) // NEIGHBOURHOOD, key)


def _hashed(numbers: Tensor, key: int) -> Tensor:
    """See `random_bits.hashed`."""
    h = (numbers * INCREMENT + key) & _LOW
    for shift, factor in FACTORS:
        h = ((h ^ (h >> shift)) * factor) & _LOW
    return h ^ (h >> 16)


def sign_picture(like: Tensor, key: int, weight: float) -> Tensor:
    """[3, H, W], as `like` is: see `gauss_newton.sign_picture`."""
    words = _hashed(torch.arange(-(-like.numel() // 32), device=like.device), key)
    bits = (words[:, None] >> torch.arange(32, device=like.device)) & 1
    of_one = bits.reshape(-1)[: like.numel()].reshape(like.shape)
    return torch.where(of_one > 0, weight**0.5, -(weight**0.5)).to(like.dtype)
