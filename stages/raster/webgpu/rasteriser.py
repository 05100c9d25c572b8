"""The WebGPU backend: WGSL kernels on buffers that stay on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.raster import sh
from stages.raster.camera_row import camera_row
from stages.raster.definition import (
    CONTRIBUTIONS,
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
LARGEST_WEIGHT = 3
TILE, BLOCK = 16, 1024  # pixels across; numbers of a workgroup that sorts or scans
NOWHERE = 0xFFFFFFFF  # the key of a splat that is not visible
_HARMONICS = {"C0": sh.C0, "C1": sh.C1}
_HARMONICS |= {f"C2{k}": value for k, value in enumerate(sh.C2)}
_HARMONICS |= {f"C3{k}": value for k, value in enumerate(sh.C3)}


def _kernel(file: str, entry: str, **constants: float) -> Kernel:
    return Kernel(FOLDER / f"{file}.wgsl", entry, tuple(constants.items()))


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
            sums = self._sums(
                *("contributions", forward.scene, forward.view, forward.drawn),
                *(self.device.sent(residual), LARGEST_WEIGHT),
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
        n, get, run = len(scene), self.scratch.get, self.device.run
        records, shapes = get("records", n * RECORD), get("shapes", n * SHAPE)
        keys, culled = get("keys", n), get("culled", n)
        run(
            _kernel("project", "project", COEFFICIENTS=view.coefficients(scene), **_HARMONICS),
            -(-n // 64),
            (scene.rows, self._smoothing(scene), records, shapes, keys, culled),
            self._numbers(scene, view),
        )
        made = self._lists(scene, view, shapes, keys, capacity)
        image = get("image", (6 if depths else 4) * view.pixels)
        transmittance, last = get("transmittance", view.pixels), get("last", view.pixels)
        run(
            _kernel("blend", "blend"),
            view.tiles[1],
            (records, made.members, made.starts, image, transmittance, last),
            self._picture(view, made, depths),
        )
        return Drawn(image, transmittance, last, records, keys, culled, made)

    def gradients(
        self, scene: DeviceScene, view: DeviceView, drawn: Drawn, v_image: Any
    ) -> tuple[Any, Any]:
        """([n, columns of the scene], [n, 2]) of parameters and of means on the picture, of the
        visible splats; zeros elsewhere. v_image [3, H, W]: a buffer."""
        n, get = len(scene), self.scratch.get
        sums = self._sums("gradient", scene, view, drawn, v_image, SUMS)
        out, means2d = get("gradients", n * scene.columns), get("means2d", 2 * n)
        self.device.run(
            _kernel("gradients", "gradients", COEFFICIENTS=view.coefficients(scene), **_HARMONICS),
            -(-n // 64),
            (scene.rows, self._smoothing(scene), drawn.keys, drawn.records, sums, out, means2d),
            self._numbers(scene, view),
        )
        return out, means2d

    def _smoothing(self, scene: DeviceScene) -> Any:
        return self.scratch.get("none", 1) if scene.smoothing is None else scene.smoothing

    def _numbers(self, scene: DeviceScene, view: DeviceView) -> tuple[float, ...]:
        used, smoothed = used_columns(scene.coefficients), int(scene.smoothing is not None)
        return (*view.cam, len(scene), scene.columns, used, smoothed, TILE)

    def _picture(self, view: DeviceView, made: Lists, depths: bool = False) -> tuple[float, ...]:
        colour = map(float, view.settings.background)
        return (view.width, view.height, *view.tiles, *colour, int(depths))

    def _lists(
        self,
        scene: DeviceScene,
        view: DeviceView,
        shapes: Any,
        keys: Any,
        capacity: int | None,
    ) -> Lists:
        n, (across, tiles) = len(scene), view.tiles
        get, run = self.scratch.get, self.device.run
        counts, ordered, ends = get("counts", n), get("ordered", n), get("ends", n + 1)

        def numbers(room: int, counting: int = 0) -> tuple[int, ...]:
            return (
                *(n, room, across, tiles, view.width, TILE, scene.columns),
                *(used_columns(scene.coefficients), counting),
            )

        def find(room: int, counting: int) -> None:
            entries = (get("tile_of", max(1, room)), get("row_of", max(1, room)))
            run(
                _kernel("lists", "tiles"),
                -(-(n if counting else room) // 64),
                (shapes, keys, counts, ordered, ends, *entries),
                numbers(room, counting),
            )

        find(0, 1)
        sorted_keys, order = self._sorted("depth", keys, n, 32)
        run(
            _kernel("lists", "ties"),
            -(-(n + 1) // 64),
            (scene.rows, sorted_keys, order, counts, ordered, ends),
            numbers(0),
        )
        self._scan(ends, n + 1)
        room = int(self.device.read(ends, np.uint32, 1, n)[0]) if capacity is None else capacity
        find(room, 0)
        sorted_tiles, slots = self._sorted("tile", get("tile_of", 1), room, tiles.bit_length())
        members, starts, firsts = get("members", room), get("starts", tiles + 1), get("firsts", n)
        run(
            _kernel("lists", "arrange"),
            -(-max(room, n, tiles + 1) // 64),
            (sorted_tiles, slots, get("row_of", 1), members, starts, ordered, ends, firsts),
            numbers(room),
        )
        return Lists(members, slots, starts, firsts, counts, ends, room)

    def _sorted(self, name: str, keys: Any, n: int, bits: int) -> tuple[Any, Any]:
        """(keys sorted by their lowest `bits`, the places that they had): new buffers."""
        get, run = self.scratch.get, self.device.run
        blocks = -(-n // BLOCK)
        table = get("table", 16 * blocks)
        from_values, free = get(f"{name} values a", n), get(f"{name} values b", n)
        free_keys = [get(f"{name} keys a", n), get(f"{name} keys b", n)]
        for shift in range(0, bits, 4):
            given = (n, shift, blocks, int(shift == 0))
            run(_kernel("sort", "count"), blocks, (keys, table), given)
            self._scan(table, 16 * blocks)
            moved = free_keys[shift // 4 % 2]
            run(
                _kernel("sort", "scatter"),
                blocks,
                (keys, table, from_values, moved, free),
                given,
            )
            keys, from_values, free = moved, free, from_values
        return keys, from_values

    def _scan(self, values: Any, n: int, level: int = 0) -> None:
        """Replace n numbers by the sums of those before each."""
        blocks = -(-n // BLOCK)
        sums = self.scratch.get(f"sums {level}", blocks)
        self.device.run(_kernel("scan", "scan"), blocks, (values, sums), (n,))
        if blocks > 1:
            self._scan(sums, blocks, level + 1)
            self.device.run(_kernel("scan", "add"), blocks, (values, sums), (n,))

    def _sums(
        self,
        kernel: str,
        scene: DeviceScene,
        view: DeviceView,
        drawn: Drawn,
        planes: Any,
        largest: int,
    ) -> Any:
        """[n, SUMS]: what a kernel of `blend.wgsl` finds for each splat, from far to near over
        every tile's list. largest: the column of which the largest is taken."""
        made, n = drawn.lists, len(scene)
        raw = self.scratch.get("raw", made.capacity * SUMS)
        self.device.clear(raw, made.capacity * SUMS)
        self.device.run(
            _kernel("blend", kernel),
            view.tiles[1],
            (
                *(drawn.records, made.members, made.starts, made.slots, drawn.transmittance),
                *(drawn.last, planes, raw),
            ),
            self._picture(view, made),
        )
        sums = self.scratch.get("sums", n * SUMS)
        self.device.run(
            _kernel("sums", "add_up"),
            -(-n // 8),
            (raw, made.firsts, made.counts, sums),
            (n, made.capacity, largest),
        )
        return sums
