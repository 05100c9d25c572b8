"""The CPU backend: Numba kernels, forward and backward, with reused buffers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import ResourceError, SplatError
from stages.base.memory import MIB, available_mib
from stages.base.text import size as size_text
from stages.raster.camera_row import camera_row
from stages.raster.cpu import binning, blend, contributions
from stages.raster.cpu.projection import GEOMETRY_ROW
from stages.raster.cpu.splat_kernels import (
    CULLED,
    VISIBLE,
    project_splats,
    splat_gradients,
)
from stages.raster.cpu.tile import PIXELS, DrawnTiles
from stages.raster.definition import (
    CONTRIBUTIONS,
    Arrays,
    Backward,
    RasterSettings,
    gradient_columns,
    with_smoothing,
)
from stages.raster.kernels.pool import Pool, default_pool
from stages.scene import Camera

CHUNK = 512  # splats for each ticket; whole vectors


class Buffers:
    """Arrays by name that only grow, so that a training step allocates almost nothing."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}

    def get(self, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """An uninitialised C-contiguous array of this shape; valid until the next call. Raises
        MemoryError before it allocates more than is free: a system that promises more memory than
        it has would end the process later."""
        size = math.prod(shape)
        have = self._arrays.get(name)
        if have is None or have.size < size or have.dtype != np.dtype(dtype):
            wanted, free = size * np.dtype(dtype).itemsize, available_mib() * MIB
            if wanted > free:
                raise MemoryError(f"{size_text(wanted)} wanted, {size_text(free)} free")
            have = np.empty(size + size // 8 + 16, dtype)
            self._arrays[name] = have
        return have[:size].reshape(shape)

    def carve(
        self, *wanted: tuple[tuple[int, ...], Any], name: str = "scratch"
    ) -> list[NDArray[Any]]:
        """Uninitialised arrays of (shape, dtype) from one buffer that all calls with its name
        share: each call invalidates the arrays of the one before."""
        sizes = [math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in wanted]
        ends = [*accumulate(-(-size // 64) * 64 for size in sizes)]
        arena = self.get(name, (ends[-1],), np.uint8)
        parts = []
        for (shape, dtype), size, end in zip(wanted, sizes, ends, strict=True):
            start = end + -(-size // 64) * -64
            parts.append(arena[start : start + size].view(dtype).reshape(shape))
        return parts


@dataclass(frozen=True)
class Forward:
    """The result of a forward pass, with what the backward pass needs.

    image [4 or 6, H, W]: RGB, alpha, and if requested expected and median depth. visible [V] int32:
    rows of the splats that touch the picture, ascending. splats: what was drawn, with smoothing;
    see `definition.with_smoothing`. places [V, 4]: row, number of slots and
    first slot of each visible splat; see `binning`. The arrays are buffers of the rasteriser, valid
    until its next forward pass.
    """

    image: NDArray[np.float32]
    visible: NDArray[np.int32]
    culled: int
    splats: Arrays
    tiles: DrawnTiles
    places: NDArray[np.int32]
    cam: NDArray[np.float64]
    degree: int

    @property
    def n_intersections(self) -> int:
        return len(self.tiles.members)


class CpuRasteriser:
    """Draws and differentiates. An instance owns buffers: one thread at a time may use it."""

    def __init__(self, pool: Pool | None = None) -> None:
        self.pool = pool or default_pool()
        self.buffers = Buffers()

    def loaded(self, arrays: Arrays) -> Arrays:
        """See `definition.Rasteriser`."""
        return arrays

    def forward(
        self, arrays: Arrays, camera: Camera, settings: RasterSettings, depths: bool = False
    ) -> Forward:
        """See `definition.Rasteriser`."""
        splats, cam = with_smoothing(arrays), camera_row(camera, settings)
        degree = min(settings.sh_degree, int(arrays[4].shape[1] ** 0.5) - 1)
        width, height = camera.width, camera.height
        n, get = len(arrays[0]), self.buffers.get
        geometry = get("geometry", (n, GEOMETRY_ROW), np.float64)
        paint = get("paint", (n, 4), np.float32)
        status = get("status", (n,), np.uint8)
        self.pool.share(project_splats, CHUNK, cam, degree, splats, geometry, paint, status)
        visible = np.flatnonzero(status == VISIBLE).astype(np.int32)
        try:
            lists, places = self._lists(visible, splats[:5], geometry, paint, width, height)
        except MemoryError as error:
            raise _lists_too_large(error, camera, arrays[2][visible]) from error
        background = np.asarray(settings.background, np.float32)
        n_tiles = len(lists[0]) - 1
        transmittance = get("transmittance", (n_tiles, PIXELS), np.float32)
        last = get("last", (n_tiles, PIXELS), np.float32)
        rest = (geometry, paint, background, transmittance, last)
        tiles = DrawnTiles._make((width, height, *lists, *rest))
        image = get("image", (6 if depths else 4, height, width), np.float32)
        self.pool.share(blend.blend_tiles, tiles, depths, image)
        culled = int(np.count_nonzero(status == CULLED))
        return Forward(image, visible, culled, splats, tiles, places, cam, degree)

    def backward(self, forward: Forward, v_image: NDArray[np.float32]) -> Backward:
        """See `definition.Rasteriser`."""
        n, get, tiles = len(forward.visible), self.buffers.get, forward.tiles
        (raw,) = self.buffers.carve(((forward.n_intersections, blend.SUMS), np.float32))
        self.pool.share(blend.blend_gradient_tiles, tiles, v_image, raw)
        out = get("out", (n, gradient_columns((forward.degree + 1) ** 2)), np.float32)
        means2d = get("means2d", (n, 2), np.float32)
        self.pool.share(
            *(splat_gradients, CHUNK, forward.visible, forward.cam, forward.degree),
            *(forward.splats, tiles, forward.places, raw, out, means2d),
        )
        return Backward(forward.visible, out, means2d)

    def contributions(self, forward: Forward, residual: NDArray[np.float32]) -> NDArray[np.float64]:
        """See `definition.Rasteriser`."""
        shape = (forward.n_intersections, CONTRIBUTIONS)
        (raw,) = self.buffers.carve((shape, np.float32))
        self.pool.share(contributions.contribution_tiles, forward.tiles, residual, raw)
        out = np.empty((len(forward.visible), CONTRIBUTIONS))
        contributions.gather_contributions(raw, forward.places, out)
        return out

    def _lists(
        self,
        visible: NDArray[np.int32],
        arrays: Arrays,
        geometry: NDArray[np.float64],
        paint: NDArray[np.float32],
        width: int,
        height: int,
    ) -> tuple[tuple[NDArray[Any], ...], NDArray[np.int32]]:
        """(starts, members, slots and masks of `DrawnTiles`; `Forward.places`)."""
        n, get, share = len(visible), self.buffers.get, self.pool.share
        bounds = get("bounds", (n,), np.int32)
        share(binning.bound_tiles, visible, geometry, width, height, bounds)
        places = get("places", (n, 4), np.int32)
        most = _starts(bounds, places[:, binning.FOUND])
        tiles, masks, order, keys, order2, keys2 = self.buffers.carve(
            *(((most,), np.int32), ((most,), np.uint16), ((n,), np.int32), ((n,), np.float32)),
            *(((n,), np.int32), ((n,), np.uint32)),
        )
        share(
            *(binning.find_tiles, visible, geometry, width, height, places, tiles, masks),
            beside=lambda: binning.sort_by_depth(
                visible, paint, arrays, keys, order, keys2, order2
            ),
        )
        total = _starts(places[:, binning.COUNT], places[:, binning.SLOT])

        n_tiles = -(-width // binning.TILE) * -(-height // binning.TILE)
        positions = get("tile_counts", (binning.CHUNKS, n_tiles), np.int64)
        positions[:] = 0
        share(binning.count_tiles, order, places, tiles, positions)
        starts = get("tile_starts", (n_tiles + 1,), np.int64)
        binning.scan_counts(positions, starts)
        columns = (((total,), np.int32), ((total,), np.int32), ((total,), np.uint16))
        members, slots, masks_of = self.buffers.carve(*columns, name="lists")
        share(
            *(binning.fill_tiles, order, places, tiles, masks, positions),
            *(members, slots, masks_of),
        )
        return (starts, members, slots, masks_of), places


def _starts(counts: NDArray[np.int32], starts: NDArray[np.int32]) -> int:
    """Fill `starts` with the sums of all counts before; returns the total. Raises MemoryError if it
    needs more than 31 bits: 2 billion entries take 90 GB."""
    total = int(counts.sum(dtype=np.int64))
    if total >= 2**31:
        raise MemoryError(f"{total:,} splat-tile intersections; at most 2**31 - 1 can be drawn")
    if len(counts):
        starts[0] = 0
        np.cumsum(counts[:-1], out=starts[1:])
    return total


def _lists_too_large(
    error: MemoryError, camera: Camera, log_scales: NDArray[np.floating]
) -> SplatError:
    """The error for lists that memory cannot hold. log_scales: of the visible splats."""
    given = f"The lists of {len(log_scales):,} splats for {camera.width} x {camera.height} pixels"
    linear = bool((log_scales >= 0).all())  # lengths are, and logarithms of small lengths are not
    return ResourceError(
        "raster-memory",
        given=f"{given} do not fit into memory ({error})."
        + (" No scale is negative: they look linear and were read as logarithms." * linear),
        wanted="Splats that fill less of the picture, or a smaller picture.",
        hint="Write the natural logarithm of each scale into the file."
        if linear
        else "Ask for less: --width, --train-side or --max-splats; or close other programs.",
    )
