"""The GPU backend: Triton kernels and torch sorts on tensors that stay on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import triton.language as tl
from numpy.typing import NDArray
from torch import Tensor

from stages.raster.camera_row import camera_row
from stages.raster.definition import (
    CONTRIBUTIONS,
    LARGEST_WEIGHT,
    SH,
    Arrays,
    Backward,
    RasterSettings,
    gradient_columns,
    used_columns,
    with_smoothing,
)
from stages.raster.gpu import blend, gradients, lists, project
from stages.raster.gpu.device import float64_is_fast, gpu_errors_explained, interpreted, require
from stages.scene import Camera

VISIBLE, CULLED = 1, 2  # as `project_kernel` writes them
SMALL_TILE, LARGE_TILE = 8, 16
FEW_TILES = 4000  # large ones; an estimate: twice as many warps as blend at a time on an H100


@dataclass(frozen=True)
class DeviceScene:
    """Splats on the device. rows [N, columns]: parameters, in the columns of a gradient row.
    coefficients: SH coefficients a channel. smoothing [N], or [0] for none."""

    rows: Tensor
    coefficients: int
    smoothing: Tensor

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def layout(self) -> tuple[int, int]:
        """(columns of a row, how many of them hold parameters)."""
        return self.rows.shape[1], used_columns(self.coefficients)


@dataclass(frozen=True)
class DeviceView:
    """A camera on the device, and how it draws. cam: see `camera_row`."""

    cam: Tensor
    width: int
    height: int
    settings: RasterSettings

    def coefficients(self, scene: DeviceScene) -> int:
        """Number of SH coefficients a channel that take part."""
        return min((self.settings.sh_degree + 1) ** 2, scene.coefficients)


@dataclass(frozen=True)
class Lists:
    """The splats of each tile.

    members [capacity]: rows, tile by tile from starts[tile], nearest first. slots: where each
    entry's gradient goes; the slots of a splat are contiguous. firsts, counts [N]: first slot and
    number of slots of each splat. total: number of entries, a tensor. Entries beyond the capacity
    are not drawn.
    """

    members: Tensor
    slots: Tensor
    starts: Tensor
    firsts: Tensor
    counts: Tensor
    total: Tensor


@dataclass(frozen=True)
class Drawn:
    """A forward pass on the device. image [4 or 6, H, W]; light, last [H, W]: see `blend_kernel`;
    records, keys, status [N]: see `project_kernel`."""

    image: Tensor
    transmittance: Tensor
    last: Tensor
    records: Tensor
    keys: Tensor
    status: Tensor
    lists: Lists


@dataclass(frozen=True)
class Forward:
    """A `definition.Forward` with what the backward pass needs."""

    image: NDArray[np.float32]
    visible: NDArray[np.int32]
    culled: int
    scene: DeviceScene
    view: DeviceView
    drawn: Drawn


def _tiles(view: DeviceView, tile: int) -> tuple[int, int, int]:
    across, down = -(-view.width // tile), -(-view.height // tile)
    return across, down, across * down


class GpuRasteriser:
    """Draws and differentiates. tile: pixels across and down, a power of two; by default as the
    picture's size demands. real: the Triton type in which footprints are computed; by default
    float64, on a card that has few units for it float32."""

    def __init__(self, tile: int | None = None, real: Any = None) -> None:
        self.device: torch.device = require()
        emulated = interpreted()
        # the interpreter's cost depends on the number of operations, not on their width
        self.tile = tile or (32 if emulated else None)
        self.block = 4096 if emulated else 128
        self.real = real or (tl.float64 if float64_is_fast() else tl.float32)

    def loaded(self, arrays: Arrays) -> DeviceScene:
        """See `definition.Rasteriser`."""
        with gpu_errors_explained(len(arrays[0])):
            return self.scene(arrays)

    def forward(
        self,
        arrays: Arrays | DeviceScene,
        camera: Camera,
        settings: RasterSettings,
        depths: bool = False,
    ) -> Forward:
        """See `definition.Rasteriser`."""
        scene = arrays if isinstance(arrays, DeviceScene) else self.loaded(arrays)
        with gpu_errors_explained(len(scene)):
            view = self.view(camera, settings)
            drawn = self.draw(scene, view, depths)
            status, image = drawn.status.cpu().numpy(), drawn.image.cpu().numpy()
        return Forward(
            image,
            np.flatnonzero(status == VISIBLE).astype(np.int32),
            int(np.count_nonzero(status == CULLED)),
            scene,
            view,
            drawn,
        )

    def backward(self, forward: Forward, v_image: NDArray[np.float32]) -> Backward:
        """See `definition.Rasteriser`."""
        with gpu_errors_explained(len(forward.scene.rows)):
            v = torch.from_numpy(np.ascontiguousarray(v_image)).to(self.device)
            parameters, means2d = self.gradients(forward.scene, forward.view, forward.drawn, v)
            rows = torch.from_numpy(forward.visible).to(self.device).long()
            used = gradient_columns(forward.view.coefficients(forward.scene))
            return Backward(
                *(forward.visible, parameters[rows, :used].cpu().numpy()),
                means2d[rows].cpu().numpy(),
            )

    def contributions(self, forward: Forward, residual: NDArray[np.float32]) -> NDArray[np.float64]:
        """See `definition.Rasteriser`."""
        with gpu_errors_explained(len(forward.scene.rows)):
            return self._contributions(forward, residual)

    def _contributions(
        self, forward: Forward, residual: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        drawn, made = forward.drawn, forward.drawn.lists
        planes = torch.from_numpy(np.ascontiguousarray(residual)).to(self.device)
        raw = torch.zeros(len(made.members), CONTRIBUTIONS, device=self.device)
        self._over_tiles(blend.contribution_kernel, forward.view, drawn, planes, raw)
        sums = self._summed(raw, made, tl.float64)
        found = sums.cpu().numpy()[forward.visible]
        largest = torch.zeros(len(made.counts), device=self.device)
        by_entry = raw[made.slots, LARGEST_WEIGHT]
        largest.scatter_reduce_(0, made.members.long(), by_entry, "amax")
        found[:, LARGEST_WEIGHT] = largest.cpu().numpy()[forward.visible]
        return found

    def scene(self, arrays: Arrays) -> DeviceScene:
        """Rows on the device from arrays on the host."""
        means, quaternions, log_scales, opacity_logits, sh, smoothing = with_smoothing(arrays)
        n, coefficients = len(means), sh.shape[1]
        parts = (
            means,
            quaternions,
            log_scales,
            opacity_logits[:, None],
            sh.reshape(n, 3 * coefficients),
        )
        rows = np.zeros((n, gradient_columns(coefficients)), np.float32)
        np.concatenate(parts, 1, out=rows[:, : SH + 3 * coefficients])
        widths = torch.tensor(smoothing, device=self.device)
        return DeviceScene(torch.from_numpy(rows).to(self.device), coefficients, widths)

    def view(self, camera: Camera, settings: RasterSettings) -> DeviceView:
        """A camera and settings, on the device."""
        cam = torch.from_numpy(camera_row(camera, settings)).to(self.device)
        return DeviceView(cam, camera.width, camera.height, settings)

    def draw(
        self,
        scene: DeviceScene,
        view: DeviceView,
        depths: bool = False,
        capacity: int | None = None,
    ) -> Drawn:
        """Draw. capacity: number of entries that the lists have room for. By default it is read
        from the device, which waits for the device."""
        n = len(scene)
        like: dict[str, Any] = {"device": self.device}
        records = torch.empty(n, project.RECORD.value, **like)
        shapes = torch.empty(n, project.SHAPE.value, **like)
        keys = torch.empty(n, **like)
        status = torch.empty(n, dtype=torch.int8, **like)
        if n:
            project.project_kernel[self._grid(n)](
                *(view.cam, scene.rows, scene.smoothing, n, *scene.layout),
                *(view.width, view.height, self._tile(view), records, shapes, keys, status),
                SMOOTH=len(scene.smoothing) > 0,
                ANTIALIAS=view.settings.antialias,
                REAL=self.real,
                BLOCK=self.block,
            )
            project.colour_kernel[self._grid(n)](
                *(view.cam, scene.rows, keys, records, n, scene.rows.shape[1]),
                COEFFICIENTS=view.coefficients(scene),
                REAL=self.real,
                BLOCK=self.block,
            )
        made = self._lists(scene, view, shapes, keys, capacity)
        planes = 6 if depths else 4
        image = torch.empty(planes, view.height, view.width, **like)
        transmittance = torch.empty(view.height, view.width, **like)
        last = torch.empty(view.height, view.width, dtype=torch.int32, **like)
        blend.blend_kernel[(self._tiles(view)[2],)](
            *(records, made.members, made.starts, image, transmittance, last),
            *map(float, view.settings.background),
            *(view.width, view.height, self._tiles(view)[0]),
            DEPTHS=depths,
            TILE=self._tile(view),
            num_warps=1,
        )
        return Drawn(image, transmittance, last, records, keys, status, made)

    def gradients(
        self, scene: DeviceScene, view: DeviceView, drawn: Drawn, v_image: Tensor
    ) -> tuple[Tensor, Tensor]:
        """([N, columns of the scene], [N, 2]) of parameters and of means on the picture, of the
        visible splats; zeros elsewhere. v_image [3, H, W]."""
        n, columns = scene.rows.shape
        like: dict[str, Any] = {"device": self.device}
        raw = torch.zeros(len(drawn.lists.members), blend.SUMS.value, **like)
        self._over_tiles(blend.blend_gradient_kernel, view, drawn, v_image, raw)
        sums = self._summed(raw, drawn.lists, self.real)
        out, means2d = torch.zeros(n, columns, **like), torch.zeros(n, 2, **like)
        if n:
            gradients.colour_gradient_kernel[self._grid(n)](
                *(view.cam, scene.rows, drawn.keys, drawn.records, sums, n, columns, out),
                COEFFICIENTS=view.coefficients(scene),
                REAL=self.real,
                BLOCK=self.block,
            )
            gradients.splat_gradient_kernel[self._grid(n)](
                *(view.cam, scene.rows, scene.smoothing, drawn.keys, drawn.records, sums, n),
                *(columns, out, means2d),
                SMOOTH=len(scene.smoothing) > 0,
                ANTIALIAS=view.settings.antialias,
                REAL=self.real,
                BLOCK=self.block,
            )
        return out, means2d

    def _grid(self, n: int) -> tuple[int]:
        return (-(-n // self.block),)

    def _tiles(self, view: DeviceView) -> tuple[int, int, int]:
        """(tiles across, down, all)."""
        return _tiles(view, self._tile(view))

    def _tile(self, view: DeviceView) -> int:
        """Pixels across and down. A tile is one warp's work: few large ones leave a card idle."""
        few = _tiles(view, LARGE_TILE)[2] < FEW_TILES
        return self.tile or (SMALL_TILE if few else LARGE_TILE)

    def _lists(
        self,
        scene: DeviceScene,
        view: DeviceView,
        shapes: Tensor,
        keys: Tensor,
        capacity: int | None,
    ) -> Lists:
        n, (across, _, tiles) = len(scene), self._tiles(view)
        like: dict[str, Any] = {"device": self.device}
        counts = torch.zeros(n, dtype=torch.int32, **like)
        by_depth, order = torch.sort(keys, stable=True)
        ordered = torch.empty_like(order)
        if n:
            plain: dict[str, Any] = {"enable_fp_fusion": False}
            lists.count_kernel[self._grid(n)](
                *(shapes, keys, counts, n, view.width, self._tile(view)), BLOCK=self.block, **plain
            )
            lists.ties_kernel[self._grid(n)](
                *(by_depth, order, ordered, scene.rows, n, *scene.layout),
                BLOCK=self.block,
            )
        ends = torch.cumsum(counts[ordered], 0)
        total = ends[-1:] if n else torch.zeros(1, dtype=torch.int64, **like)
        room = int(total.item()) if capacity is None else capacity
        # radix sorts work by bytes; 16 bits are enough for pictures of 8 million pixels
        keyed = torch.int16 if tiles < 2**15 else torch.int32
        tile_of = torch.empty(room, dtype=keyed, **like)
        row_of = torch.empty(room, dtype=torch.int32, **like)
        if room and n:
            lists.entries_kernel[self._grid(room)](
                *(shapes, ordered, ends, n, across, tiles, view.width, self._tile(view)),
                *(room, 1 << n.bit_length(), tile_of, row_of),
                BLOCK=self.block,
                **plain,
            )
        sorted_tiles, slots = torch.sort(tile_of, stable=True)
        bounds = torch.arange(tiles + 1, dtype=keyed, **like)
        starts = torch.searchsorted(sorted_tiles, bounds)
        firsts = torch.empty(n, dtype=torch.int64, **like)
        firsts[ordered] = ends - counts[ordered]
        return Lists(row_of[slots], slots, starts, firsts, counts, total)

    def _over_tiles(
        self, kernel: Any, view: DeviceView, drawn: Drawn, planes: Tensor, out: Tensor
    ) -> None:
        """Run a kernel from far to near over every tile's list; one row of `out` for each entry."""
        made = drawn.lists
        kernel[(self._tiles(view)[2],)](
            *(
                drawn.records,
                made.members,
                made.slots,
                made.starts,
                drawn.transmittance,
                drawn.last,
            ),
            *(planes, out, *map(float, view.settings.background)),
            *(view.width, view.height, self._tiles(view)[0]),
            TILE=self._tile(view),
            num_warps=1,
        )

    def _summed(self, raw: Tensor, made: Lists, real: Any) -> Tensor:
        """[N, columns of raw]: each splat's rows of `raw`, added up in a fixed order."""
        n, width = len(made.counts), raw.shape[1]
        dtype = torch.float64 if real == tl.float64 else torch.float32
        sums = torch.zeros(n, width, dtype=dtype, device=self.device)
        if n:
            splats, lanes = (1024, 8) if interpreted() else (4, 8)
            gradients.sum_kernel[(-(-n // splats),)](
                *(raw, made.firsts, made.counts, sums, n, len(raw)),
                WIDTH=width,
                REAL=real,
                BLOCK=splats,
                LANES=lanes,
                num_warps=1,
            )
        return sums
