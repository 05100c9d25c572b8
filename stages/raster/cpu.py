"""The CPU backend: Numba kernels, forward and backward, with buffers that are kept and reused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.raster import binning, blend, contributions
from stages.raster.api import RasterSettings, Rendering
from stages.raster.pool import Pool, default_pool
from stages.raster.projection import CAMERA_ROW, GEOMETRY_ROW, camera_row
from stages.raster.splat_kernels import project_splats, shade_splats, splat_gradients
from stages.scene import Camera, Splats

CHUNK = 512  # splats a ticket


class Buffers:
    """Arrays by name that only ever grow, so that a training step allocates next to nothing."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}

    def get(self, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """An uninitialised C-contiguous array of this shape; valid until the next call."""
        size = int(np.prod(shape))
        have = self._arrays.get(name)
        if have is None or have.size < size or have.dtype != np.dtype(dtype):
            have = np.empty(size + size // 4 + 16, dtype)
            self._arrays[name] = have
        return have[:size].reshape(shape)

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self._arrays.values())


@dataclass
class Forward:
    """What a forward pass leaves for the way back. image [5, H, W]: RGB, alpha, depth.

    visible [V] int32: rows of the splats that touch the picture, nearest first. n_tiles [V]: how
    many tiles each touches. The arrays belong to the rasteriser's buffers: valid until its next
    forward pass.
    """

    image: NDArray[np.float32]
    visible: NDArray[np.int32]
    n_intersections: int
    culled: int
    cam: NDArray[np.float64]
    degree: int
    background: NDArray[np.float32]
    width: int
    height: int


@dataclass
class Backward:
    """Gradients of the visible splats, nearest first.

    rows [V] int32. parameters [V, gradient_columns]: mean 0:3, quaternion 3:7, log-scales 7:10,
    opacity logit 10, then SH, basis function by basis function with RGB last, then zeros.
    means2d [V, 2]: of the mean on the picture, per pixel.
    """

    rows: NDArray[np.int32]
    parameters: NDArray[np.float32]
    means2d: NDArray[np.float32]


def gradient_columns(bands: int) -> int:
    """Columns of a gradient row with room for `bands` of SH: whole vectors."""
    return -(-(11 + 3 * bands) // 16) * 16


class CpuRasteriser:
    """Draws and differentiates. One instance a thread of control; it owns its buffers."""

    def __init__(self, pool: Pool | None = None) -> None:
        self.pool = pool or default_pool()
        self.buffers = Buffers()

    def forward(
        self,
        arrays: tuple[NDArray[np.float32], ...],
        camera: Camera,
        settings: RasterSettings,
    ) -> Forward:
        """arrays: means, quaternions, log_scales, opacity_logits, sh (C-contiguous)."""
        cam = camera_row(camera, settings)
        assert len(cam) == CAMERA_ROW
        visible, keys = self._project(arrays, cam)
        order = self._sort(keys, visible, arrays)
        n = len(order)
        get = self.buffers.get
        geometry = get("geometry", (n, GEOMETRY_ROW), np.float64)
        paint = get("paint", (n, 4), np.float32)
        degree = min(settings.sh_degree, int(arrays[4].shape[1] ** 0.5) - 1)
        self.pool.share(
            shade_splats,
            CHUNK,
            order,
            self._all_geometry,
            cam,
            degree,
            arrays[0],
            arrays[4],
            geometry,
            paint,
        )
        n_intersections = self._bin(geometry, n, camera.width, camera.height)
        background = np.asarray(settings.background, np.float32)
        tiles = len(self._tile_starts) - 1
        image = get("image", (5, camera.height, camera.width), np.float32)
        self._light = get("light", (tiles, blend.PIXELS), np.float32)
        self._last = get("last", (tiles, blend.PIXELS), np.float32)
        self.pool.share(
            blend.blend_tiles,
            camera.width,
            camera.height,
            self._tile_starts,
            self._ranks,
            self._rows,
            geometry,
            paint,
            background,
            image,
            self._light,
            self._last,
        )
        self._geometry, self._paint = geometry, paint
        return Forward(
            image,
            order,
            n_intersections,
            self._culled,
            cam,
            degree,
            background,
            camera.width,
            camera.height,
        )

    def backward(
        self,
        arrays: tuple[NDArray[np.float32], ...],
        forward: Forward,
        v_image: NDArray[np.float32],
    ) -> Backward:
        """Gradients of the visible splats, from v_image [3, H, W]."""
        n = len(forward.visible)
        get = self.buffers.get
        raw = get("gradients", (forward.n_intersections, blend.GRADIENTS), np.float32)
        self.pool.share(
            blend.blend_gradient_tiles,
            forward.width,
            forward.height,
            self._tile_starts,
            self._ranks,
            self._slots,
            self._rows,
            self._geometry,
            self._paint,
            forward.background,
            self._light,
            self._last,
            v_image,
            raw,
        )
        out = get("out", (n, gradient_columns((forward.degree + 1) ** 2)), np.float32)
        means2d = get("means2d", (n, 2), np.float32)
        self.pool.share(
            splat_gradients,
            CHUNK,
            forward.visible,
            forward.cam,
            forward.degree,
            *arrays,
            self._geometry,
            self._paint,
            self._slot_starts,
            raw,
            out,
            means2d,
        )
        return Backward(forward.visible, out, means2d)

    def contributions(self, forward: Forward, residual: NDArray[np.float32]) -> NDArray[np.float64]:
        """[V, 3] for the visible splats: change of the squared error against the photograph if
        the splat were removed, sum of its weights, its largest weight.

        residual [3, H, W]: render less photograph.
        """
        shape = (forward.n_intersections, contributions.COLUMNS)
        raw = self.buffers.get("contributions", shape, np.float32)
        self.pool.share(
            contributions.contribution_tiles,
            forward.width,
            forward.height,
            self._tile_starts,
            self._ranks,
            self._slots,
            self._rows,
            self._geometry,
            self._paint,
            forward.background,
            self._light,
            self._last,
            residual,
            raw,
        )
        out = np.empty((len(forward.visible), contributions.COLUMNS))
        contributions.gather_contributions(raw, self._slot_starts, out)
        return out

    def _project(
        self, arrays: tuple[NDArray[np.float32], ...], cam: NDArray[np.float64]
    ) -> tuple[NDArray[np.int32], NDArray[np.uint32]]:
        n = len(arrays[0])
        get = self.buffers.get
        self._all_geometry = get("all_geometry", (n, GEOMETRY_ROW), np.float64)
        depth = get("depth", (n,), np.float32)
        status = get("status", (n,), np.uint8)
        self.pool.share(project_splats, CHUNK, cam, *arrays, self._all_geometry, depth, status)
        self._culled = int(np.count_nonzero(status == 2))
        visible = np.flatnonzero(status == 1).astype(np.int32)
        return visible, depth[visible].view(np.uint32)

    def _sort(
        self,
        keys: NDArray[np.uint32],
        visible: NDArray[np.int32],
        arrays: tuple[NDArray[np.float32], ...],
    ) -> NDArray[np.int32]:
        n = len(visible)
        get = self.buffers.get
        # depths are positive, so their bits sort as they do
        binning.radix_order(
            keys, visible, get("keys2", (n,), np.uint32), get("order2", (n,), np.int32)
        )
        binning.settle_ties(keys, visible, *arrays)
        return visible

    def _bin(self, geometry: NDArray[np.float64], n: int, width: int, height: int) -> int:
        tiles = -(-width // binning.TILE) * -(-height // binning.TILE)
        get = self.buffers.get
        counts = get("tile_counts", (binning.CHUNKS, tiles), np.int64)
        counts[:] = 0
        splat_tiles = get("splat_tiles", (n,), np.int32)
        self._tile_starts = get("tile_starts", (tiles + 1,), np.int64)
        self._slot_starts = get("slot_starts", (n + 1,), np.int64)
        self.pool.share(binning.count_tiles, geometry, n, width, height, counts, splat_tiles)
        total = int(binning.scan_counts(counts, self._tile_starts, splat_tiles, self._slot_starts))
        self._ranks = get("ranks", (total,), np.int32)
        self._slots = get("slots", (total,), np.int64)
        self._rows = get("rows", (total,), np.uint8)
        self.pool.share(
            binning.fill_tiles,
            geometry,
            n,
            width,
            height,
            counts,
            self._slot_starts,
            self._ranks,
            self._slots,
            self._rows,
        )
        return total


def splat_arrays(splats: Splats) -> tuple[NDArray[np.float32], ...]:
    """The five parameter arrays, C-contiguous float32."""
    return tuple(
        np.ascontiguousarray(a, dtype=np.float32)
        for a in (
            splats.means,
            splats.quaternions,
            splats.log_scales,
            splats.opacity_logits,
            splats.sh,
        )
    )


def render_cpu(splats: Splats, camera: Camera, settings: RasterSettings) -> Rendering:
    """`render` by the kernels."""
    forward = CpuRasteriser().forward(splat_arrays(splats), camera, settings)
    image = forward.image
    return Rendering(
        np.ascontiguousarray(image[:3].transpose(1, 2, 0)),
        image[3].copy(),
        image[4].copy(),
        forward.culled,
    )
