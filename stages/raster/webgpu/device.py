"""The device of the WebGPU kernels: an adapter of wgpu, its buffers, and what is recorded for it.

Dispatches are recorded in one compute pass and start with `submit`, or when a result is read. The
numbers that a dispatch takes lie in one uniform buffer, 256 bytes apart, which is written before
the submission. A dispatch sees what those before it wrote.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import ResourceError
from stages.raster import definition
from stages.raster.definition import MemoryFull

try:
    import wgpu
except (ImportError, OSError, RuntimeError) as _error:  # not installed, or no library for it here
    wgpu: Any = None  # type: ignore[no-redef]
    _IMPORT_FAULT = f"wgpu cannot be imported ({_error})"

FOLDER = Path(__file__).parent
MOST_GROUPS = 65535  # in one dimension of a dispatch
_SLOT, _SLOTS = 256, 512  # bytes for the numbers of a dispatch; dispatches in one submission
# Where Linux shows a card to programs: a render node, NVIDIA's driver, Windows' one below WSL.
_CARDS = ("dri/renderD*", "nvidiactl", "dxg")
_TOO_LARGE = re.compile("[Bb]uffer (size|binding)")  # of what wgpu says
_CONSTANTS = (
    *("ALPHA_MIN", "ALPHA_MAX", "TRANSMITTANCE_MIN", "LOG_SCALE_MAX", "SCALE_MAX", "COLOUR_MAX"),
    *("QUATERNION_MIN", "MEAN", "ROTATION", "LOG_SCALE", "OPACITY", "SH", "CONTRIBUTIONS"),
)


@dataclass(frozen=True)
class Kernel:
    """An entry point of a file of WGSL.

    file: where it is; a line "//include NAME" takes in another file of this folder. entry: the
    function. constants: (name, number) pairs that stand before the source, beside those of
    `definition`.
    """

    file: Path
    entry: str
    constants: tuple[tuple[str, float], ...] = ()

    def source(self) -> str:
        """The whole text."""
        shared = [(name, _within(name, getattr(definition, name))) for name in _CONSTANTS]
        lines = [f"const {name} = {number!r};" for name, number in (*shared, *self.constants)]
        text = re.sub(
            r"^//include (\S+)$",
            lambda found: (FOLDER / found[1]).read_text(encoding="utf-8"),
            self.file.read_text(encoding="utf-8"),
            flags=re.M,
        )
        return "\n".join([*lines, text])


def _within(name: str, bound: float) -> float:
    """A number that float32 holds, not beyond a bound that float32 may not hold."""
    if not isinstance(bound, float):
        return bound
    found, largest = np.float32(bound), name.endswith("_MAX")
    if float(found) > bound if largest else float(found) < bound:
        found = np.nextafter(found, np.float32(0 if largest else np.inf))
    return float(found)


def why_unavailable() -> str:
    """Why "auto" does not choose this backend on this machine; "" if it does."""
    if wgpu is not None:
        if not _may_have_card():
            return f"Linux shows no GPU (in /dev: {', '.join(_CARDS)})"
        with suppress(Exception):  # `missing` says which
            info = _adapter().info
            if info["adapter_type"] == "CPU":  # known without a device, which takes a second there
                return f"its adapter is a program on the CPU ({info['device']})"
    return missing()


def _may_have_card() -> bool:
    """Whether there may be a GPU. Looking for adapters takes a second, in each process, on machines
    that have software ones alone."""
    return sys.platform != "linux" or any(any(Path("/dev").glob(card)) for card in _CARDS)


@functools.cache
def missing() -> str:
    """Why the kernels cannot run here at all; "" if they can. Looked up once in a process."""
    if wgpu is None:
        return _IMPORT_FAULT
    try:
        _adapter()
        device()
    except Exception as error:  # a driver may fail in any way
        return f"no adapter with WebGPU's limits: {(str(error).splitlines() or [''])[0]}"
    return ""


def describe() -> str:
    """Adapter, driver and version of wgpu, in one line."""
    require()
    info = _adapter().info
    name, driver = info["device"] or info["description"], info["description"]
    return f"{name}, {info['backend_type']}, {driver}, wgpu {wgpu.__version__}"


def require() -> Device:
    """The device to run on. Raises SplatError if there is none."""
    fault = missing()
    if fault:
        raise ResourceError(
            "raster-no-webgpu",
            given=f"The backend webgpu cannot run here: {fault}.",
            wanted="It takes the package wgpu, and a driver for Vulkan, Metal or Direct3D 12.",
            hint='Install it with pip install "splatcli[webgpu]", or choose --backend cpu.',
        )
    return device()


@functools.cache
def _adapter() -> Any:
    if importlib.util.find_spec("triton"):
        # loaded after the LLVM of Mesa's drivers, Triton's crashes; the other order works
        importlib.import_module("triton")
    with _drivers_silent():
        return wgpu.gpu.request_adapter_sync(power_preference=wgpu.PowerPreference.high_performance)


@contextmanager
def _drivers_silent() -> Iterator[None]:
    """Without what drivers write to standard error while they are looked for: those that cannot
    serve complain, and no user can do anything about it."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@functools.cache
def device() -> Device:
    """The device of this process."""
    return Device(_adapter())


class Device:
    """A device of wgpu, and the dispatches that were recorded but not yet submitted.

    largest: bytes that one buffer may hold.
    """

    def __init__(self, adapter: Any) -> None:
        raised = ("max_storage_buffer_binding_size", "max_buffer_size")
        limits = {name: adapter.limits[name.replace("_", "-")] for name in raised}
        self.wgpu = adapter.request_device_sync(required_limits=limits)
        self.largest = min(limits.values())
        usage = wgpu.BufferUsage.UNIFORM | wgpu.BufferUsage.COPY_DST
        self._uniforms = self.wgpu.create_buffer(size=_SLOT * _SLOTS, usage=usage)
        self._numbers, self._used = np.zeros((_SLOTS, _SLOT // 4), np.uint32), 0
        self._encoder: Any = None
        self._pass: Any = None

    def empty(self, words: int) -> Any:
        """A new buffer for so many numbers of 32 bits, at least four (a vector); zeros."""
        usage = wgpu.BufferUsage
        return self.wgpu.create_buffer(
            size=4 * max(4, words), usage=usage.STORAGE | usage.COPY_SRC | usage.COPY_DST
        )

    def sent(self, array: NDArray[Any]) -> Any:
        """A new buffer with the bytes of `array`, filled up to whole numbers of 32 bits."""
        found = self.empty(-(-array.nbytes // 4))
        self.send(array, found)
        return found

    def send(self, array: NDArray[Any], buffer: Any, offset: int = 0) -> None:
        """Copy `array` into a buffer from byte `offset`, after all that is recorded."""
        if array.nbytes:
            data = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
            if len(data) % 4:
                data = np.concatenate([data, np.zeros(-len(data) % 4, np.uint8)])
            self.submit()
            self.wgpu.queue.write_buffer(buffer, offset, data)

    def copy(self, source: Any, target: Any, words: int, offsets: tuple[int, int] = (0, 0)) -> None:
        """Record a copy of so many numbers between buffers. offsets: of both, in numbers."""
        if words:
            first, second = offsets
            self._outside().copy_buffer_to_buffer(source, 4 * first, target, 4 * second, 4 * words)

    def clear(self, buffer: Any, words: int) -> None:
        """Record that a buffer's first numbers become 0."""
        if words:
            self._outside().clear_buffer(buffer, 0, 4 * words)

    def run(
        self, kernel: Kernel, groups: int, buffers: Sequence[Any], numbers: Sequence[float] = ()
    ) -> None:
        """Record a dispatch of at least so many workgroups, in rows of MOST_GROUPS: kernels find
        their own number with `group_of` and leave out those that are too many.

        buffers: for bindings 1, 2, ... of group 0; None where the kernel has none. numbers: for the
        uniform struct of binding 0, 32 bits each: a float of Python is a f32, another number a
        u32.
        """
        if groups <= 0:
            return
        if self._used == _SLOTS:
            self.submit()
        if self._pass is None:
            self._pass = self._encoding().begin_compute_pass()
        pipeline, layout = self._pipeline(kernel)
        entries = [
            {"binding": i, "resource": {"buffer": buffer}}
            for i, buffer in enumerate(buffers, 1)
            if buffer is not None
        ]
        if numbers:
            for k, number in enumerate(numbers):
                bits = np.float32(number).view(np.uint32) if isinstance(number, float) else number
                self._numbers[self._used, k] = bits
            place = {"buffer": self._uniforms, "offset": _SLOT * self._used, "size": _SLOT}
            entries.append({"binding": 0, "resource": place})
            self._used += 1
        self._pass.set_pipeline(pipeline)
        self._pass.set_bind_group(0, self.wgpu.create_bind_group(layout=layout, entries=entries))
        across = min(groups, MOST_GROUPS)
        self._pass.dispatch_workgroups(across, -(-groups // across))

    def submit(self) -> None:
        """Let the device begin with what is recorded."""
        if self._encoder is None:
            return
        encoder = self._outside()
        if self._used:
            self.wgpu.queue.write_buffer(self._uniforms, 0, self._numbers[: self._used])
        self._encoder, self._used = None, 0
        self.wgpu.queue.submit([encoder.finish()])

    def read(self, buffer: Any, dtype: Any, count: int, offset: int = 0) -> NDArray[Any]:
        """The first `count` numbers of a buffer, from number `offset`; waits for the device."""
        return self.read_later(buffer, dtype, count, offset)()

    def read_later(
        self, buffer: Any, dtype: Any, count: int, offset: int = 0
    ) -> Callable[[], NDArray[Any]]:
        """Copies numbers, as they are after all that is recorded, to where the host can read them.
        Returns a function, to be called once, that waits for them."""
        if not count:
            return lambda: np.zeros(0, dtype)
        usage = wgpu.BufferUsage.COPY_DST | wgpu.BufferUsage.MAP_READ
        landing = self.wgpu.create_buffer(size=4 * count, usage=usage)
        self.copy(buffer, landing, count, (offset, 0))
        self.submit()
        promise = landing.map_async(wgpu.MapMode.READ)

        def arrived() -> NDArray[Any]:
            promise.sync_wait()
            found = np.frombuffer(landing.read_mapped(), dtype).copy()
            landing.destroy()
            return found

        return arrived

    def _encoding(self) -> Any:
        if self._encoder is None:
            self._encoder = self.wgpu.create_command_encoder()
        return self._encoder

    def _outside(self) -> Any:
        """The encoder, outside of a compute pass."""
        if self._pass is not None:
            self._pass.end()
            self._pass = None
        return self._encoding()

    @functools.cache  # noqa: B019 - a device lives as long as the process
    def _pipeline(self, kernel: Kernel) -> tuple[Any, Any]:
        module = _module(self, kernel.source())
        stage = {"module": module, "entry_point": kernel.entry}
        made = self.wgpu.create_compute_pipeline(layout="auto", compute=stage)
        return made, made.get_bind_group_layout(0)


@functools.cache
def _module(device: Device, source: str) -> Any:
    return device.wgpu.create_shader_module(code=source)


class Buffers:
    """Buffers by name that only grow: a step allocates nothing, and a buffer keeps what it held."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self._buffers: dict[str, Any] = {}

    def get(self, name: str, words: int) -> Any:
        """A buffer for at least so many numbers of 32 bits; valid until the next call."""
        have = self._buffers.get(name)
        if have is None or have.size < 4 * words:
            self._buffers.pop(name, None)
            room = min(words + words // 8, max(words, self.device.largest // 4))
            have = self._buffers[name] = self.device.empty(room)
        return have


@contextmanager
def errors_explained(splats: int) -> Iterator[None]:
    """Turn errors of the device, while it works on so many splats, into SplatError."""
    try:
        yield
    except wgpu.GPUError as error:
        said = str(error).strip().rpartition("\n")[2].strip()
        if isinstance(error, wgpu.GPUOutOfMemoryError) or _TOO_LARGE.search(said):
            fits = min(splats // 2, device().largest // 256)
            raise MemoryFull(splats, fits, said) from error
        if isinstance(error, wgpu.GPUValidationError) and "device is lost" not in said:
            raise  # of this program
        raise ResourceError(
            "raster-webgpu-failed",
            given=f"The GPU stopped: {said}.",
            wanted="A GPU that answers.",
            hint="Run `splat doctor`, close other programs on the card, or choose --backend cpu.",
        ) from error
