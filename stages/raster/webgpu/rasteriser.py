"""The WebGPU backend: WGSL kernels on buffers that stay on the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.raster import sh
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
from stages.raster.webgpu.device import FOLDER, Buffers, Kernel, errors_explained, require
from stages.scene import Camera

RECORD, SHAPE, SUMS = 16, 8, 9  # numbers of a record, a shape and of the sums of a splat
TILE, BLOCK = 16, 1024  # pixels across; numbers that a workgroup sorts or scans
NOWHERE = 0xFFFFFFFF  # the key of a splat that is not visible
_HARMONICS = {"C0": sh.C0, "C1": sh.C1}
_HARMONICS |= {f"C2{k}": value for k, value in enumerate(sh.C2)}
_HARMONICS |= {f"C3{k}": value for k, value in enumerate(sh.C3)}


@dataclass(frozen=True)
class DeviceScene:
    """Splats on the device. rows [n, columns]: parameters, in the columns of a gradient row.
    coefficients: SH coefficients a channel. smoothing [n], or None."""

    rows: Any
    n: int
    coefficients: int
    smoothing: Any = None

    def __len__(self) -> int:
        return self.n

    @property
    def columns(self) -> int:
        return gradient_columns(self.coefficients)


@dataclass(frozen=True)
class DeviceView:
    """A camera, and how it draws. cam: see `camera_row`."""

    cam: tuple[float, ...]
    width: int
    height: int
    settings: RasterSettings

    def coefficients(self, scene: DeviceScene) -> int:
        """Number of SH coefficients a channel that take part."""
        return min((self.settings.sh_degree + 1) ** 2, scene.coefficients)

    @property
    def tiles(self) -> tuple[int, int]:
        """(tiles across, all)."""
        across = -(-self.width // TILE)
        return across, across * -(-self.height // TILE)

    @property
    def pixels(self) -> int:
        return self.width * self.height


@dataclass(frozen=True)
class Lists:
    """The splats of each tile.

    members [capacity]: rows, tile by tile from starts[tile], nearest first. slots: where each
    entry's gradient goes; the slots of a splat are contiguous. firsts, counts [n]: first slot and
    number of slots of each splat. ends [n + 1]: the last is the number of entries. Entries beyond
    the capacity are not drawn.
    """

    members: Any
    slots: Any
    starts: Any
    firsts: Any
    counts: Any
    ends: Any
    capacity: int


@dataclass(frozen=True)
class Drawn:
    """A forward pass on the device, in buffers that the next one uses again. image [4 or 6, H, W];
    transmittance, last [H, W]: see `blend.wgsl`; records, keys, culled [n]: see `project.wgsl`."""

    image: Any
    transmittance: Any
    last: Any
    records: Any
    keys: Any
    culled: Any
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


class WebGpuRasteriser:
    """Draws and differentiates."""

    def __init__(self) -> None:
        self.device = require()
        self.scratch = Buffers(self.device)

    def loaded(self, arrays: Arrays) -> DeviceScene:
        """See `definition.Rasteriser`."""
        with errors_explained(len(arrays[0])):
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
        with errors_explained(len(scene)):
            view = self.view(camera, settings)
            drawn = self.draw(scene, view, depths)
            image = self.device.read(drawn.image, np.float32, (6 if depths else 4) * view.pixels)
            keys = self.device.read(drawn.keys, np.uint32, len(scene))
            culled = self.device.read(drawn.culled, np.uint32, len(scene))
        visible = np.flatnonzero(keys != NOWHERE).astype(np.int32)
        picture = image.reshape(-1, view.height, view.width)
        return Forward(picture, visible, int(culled.sum()), scene, view, drawn)

    def backward(self, forward: Forward, v_image: NDArray[np.float32]) -> Backward:
        """See `definition.Rasteriser`."""
        scene, rows = forward.scene, forward.visible
        with errors_explained(len(scene)):
            parameters, means2d = self.gradients(
                scene, forward.view, forward.drawn, self.device.sent(v_image)
            )
            used = gradient_columns(forward.view.coefficients(scene))
            found = self.device.read(parameters, np.float32, len(scene) * scene.columns)
            places = self.device.read(means2d, np.float32, 2 * len(scene)).reshape(-1, 2)
        return Backward(rows, found.reshape(-1, scene.columns)[rows, :used], places[rows])

    def contributions(self, forward: Forward, residual: NDArray[np.float32]) -> NDArray[np.float64]:
        """See `definition.Rasteriser`."""
        n = len(forward.scene)
        with errors_explained(n):
            planes = self.device.sent(residual)
            sums = self._sums(
                "contributions", n, forward.view, forward.drawn, planes, LARGEST_WEIGHT
            )
            found = self.device.read(sums, np.float32, SUMS * n).reshape(n, SUMS)
        return found[forward.visible, :CONTRIBUTIONS].astype(np.float64)

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
        widths = self.device.sent(smoothing) if len(smoothing) else None
        return DeviceScene(self.device.sent(rows), n, coefficients, widths)

    def view(self, camera: Camera, settings: RasterSettings) -> DeviceView:
        """A camera and settings, for the device."""
        cam = tuple(map(float, camera_row(camera, settings)))
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
        n, get = len(scene), self.scratch.get
        records, shapes = get("records", n * RECORD), get("shapes", n * SHAPE)
        keys, culled = get("keys", n), get("culled", n)
        self._over_splats("project", scene, view, records, shapes, keys, culled)
        made = self._lists(scene, view, shapes, keys, capacity)
        image = get("image", (6 if depths else 4) * view.pixels)
        transmittance, last = get("transmittance", view.pixels), get("last", view.pixels)
        buffers = (records, made.members, made.starts, image, transmittance, last)
        self._run("blend", "blend", view.tiles[1], 1, buffers, _picture(view, depths))
        return Drawn(image, transmittance, last, records, keys, culled, made)

    def gradients(
        self, scene: DeviceScene, view: DeviceView, drawn: Drawn, v_image: Any
    ) -> tuple[Any, Any]:
        """([n, columns of the scene], [n, 2]) of parameters and of means on the picture, of the
        visible splats; zeros elsewhere. v_image [3, H, W]: a buffer."""
        n, get = len(scene), self.scratch.get
        sums = self._sums("gradient", n, view, drawn, v_image)
        out, means2d = get("gradients", n * scene.columns), get("means2d", 2 * n)
        buffers = (drawn.keys, drawn.records, sums, out, means2d)
        self._over_splats("gradients", scene, view, *buffers)
        return out, means2d

    def _run(
        self,
        file: str,
        entry: str,
        items: int,
        lanes: int,
        buffers: Sequence[Any],
        numbers: Sequence[float],
    ) -> None:
        """Record a dispatch over so many items, of which a workgroup has `lanes`."""
        self.device.run(
            Kernel(FOLDER / f"{file}.wgsl", entry), -(-items // lanes), buffers, numbers
        )

    def _over_splats(self, name: str, scene: DeviceScene, view: DeviceView, *buffers: Any) -> None:
        """Record a dispatch of a kernel that computes footprints."""
        constants = {"COEFFICIENTS": view.coefficients(scene), **_HARMONICS}
        kernel = Kernel(FOLDER / f"{name}.wgsl", name, tuple(constants.items()))
        smoothed = scene.smoothing is not None
        widths = scene.smoothing if smoothed else self.scratch.get("none", 1)
        used = used_columns(scene.coefficients)
        numbers = (*view.cam, len(scene), scene.columns, used, int(smoothed), TILE)
        self.device.run(kernel, -(-len(scene) // 64), (scene.rows, widths, *buffers), numbers)

    def _lists(
        self,
        scene: DeviceScene,
        view: DeviceView,
        shapes: Any,
        keys: Any,
        capacity: int | None,
    ) -> Lists:
        n, (across, tiles), get = len(scene), view.tiles, self.scratch.get
        counts, ordered, ends = get("counts", n), get("ordered", n), get("ends", n + 1)

        def run(entry: str, items: int, room: int, *buffers: Any) -> None:
            counting = int(entry == "tiles" and not room)
            numbers = (n, room, across, tiles, view.width, TILE, scene.columns)
            used = used_columns(scene.coefficients)
            self._run("lists", entry, items, 64, buffers, (*numbers, used, counting))

        none = get("tile_of", 1), get("row_of", 1)
        run("tiles", n, 0, shapes, keys, counts, ordered, ends, *none)
        sorted_keys, order = self._sorted("depth", keys, n, 32)
        run("ties", n + 1, 0, scene.rows, sorted_keys, order, counts, ordered, ends)
        self._scan(ends, n + 1)
        room = int(self.device.read(ends, np.uint32, 1, n)[0]) if capacity is None else capacity
        tile_of, row_of = get("tile_of", room), get("row_of", room)
        run("tiles", room, room, shapes, keys, counts, ordered, ends, tile_of, row_of)
        sorted_tiles, slots = self._sorted("tile", tile_of, room, tiles.bit_length())
        members, starts, firsts = get("members", room), get("starts", tiles + 1), get("firsts", n)
        buffers = (sorted_tiles, slots, row_of, members, starts, ordered, ends, firsts)
        run("arrange", max(room, n, tiles + 1), room, *buffers)
        return Lists(members, slots, starts, firsts, counts, ends, room)

    def _sorted(self, name: str, keys: Any, n: int, bits: int) -> tuple[Any, Any]:
        """(keys sorted by their lowest `bits`, the places that they had): buffers of that name."""
        get, blocks = self.scratch.get, -(-n // BLOCK)
        table, values, free = (get("table", 16 * blocks), get(f"{name} 0", n), get(f"{name} 1", n))
        free_keys = get(f"{name} 2", n), get(f"{name} 3", n)
        for shift in range(0, bits, 4):
            numbers, moved = (n, shift, blocks, int(shift == 0)), free_keys[shift // 4 % 2]
            self._run("sort", "count", n, BLOCK, (keys, table), numbers)
            self._scan(table, 16 * blocks)
            self._run("sort", "scatter", n, BLOCK, (keys, table, values, moved, free), numbers)
            keys, values, free = moved, free, values
        return keys, values

    def _scan(self, values: Any, n: int, level: int = 0) -> None:
        """Replace n numbers by the sums of those before each."""
        blocks = -(-n // BLOCK)
        buffers = values, self.scratch.get(f"sums {level}", blocks)
        self._run("scan", "scan", n, BLOCK, buffers, (n,))
        if blocks > 1:
            self._scan(buffers[1], blocks, level + 1)
            self._run("scan", "add", n, BLOCK, buffers, (n,))

    def _sums(
        self, entry: str, n: int, view: DeviceView, drawn: Drawn, planes: Any, largest: int = SUMS
    ) -> Any:
        """[n, SUMS]: what an entry point of `blend.wgsl` finds for each splat in every tile's list.
        largest: the column of which the largest is taken."""
        made = drawn.lists
        raw, sums = (
            self.scratch.get("raw", made.capacity * SUMS),
            self.scratch.get("sums", n * SUMS),
        )
        self.device.clear(raw, made.capacity * SUMS)
        lists = (made.members, made.starts, made.slots)
        buffers = (drawn.records, *lists, drawn.transmittance, drawn.last, planes, raw)
        self._run("blend", entry, view.tiles[1], 1, buffers, _picture(view, False, largest))
        numbers = (n, made.capacity, largest)
        self._run("sums", "add_up", n * SUMS, 64, (raw, made.firsts, made.counts, sums), numbers)
        return sums


def _picture(view: DeviceView, depths: bool, largest: int = SUMS) -> tuple[float, ...]:
    colour = map(float, view.settings.background)
    return (view.width, view.height, *view.tiles, *colour, int(depths), largest)
