"""`splat doctor`: what this machine has, and what is missing."""

from __future__ import annotations

import importlib
import math
import os
import platform
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import typer
from PIL import Image

from splatcli import console
from stages.base import threads
from stages.base.distribution import NAME, VERSION, install_command
from stages.base.errors import Family
from stages.base.libraries import modules_of, needed, versions
from stages.base.memory import MIB, available_mib
from stages.base.text import counted, reason_of
from stages.ingest.decode import FORMATS, readers_set_up
from stages.raster.backends import AUTO, BACKENDS, Backend, backend_of
from stages.raster.gpu import device
from stages.raster.kernels import cache

_LITTLE_MEMORY_MIB = 2048.0
_LITTLE_DISK_BYTES = 2_000_000_000
_BACKEND_ADVICE = "docs/guide/{page}.md says what it takes."
# CPU minutes of a whole run of the sample, 24 photographs of 640 px, with AVX-512; see README.
_CPU_MINUTES = {"preview": 3.0, "standard": 5.0}
_WITHOUT_AVX512 = 2.0
_VIDEO_CODECS = ("h264", "hevc", "av1", "vp9", "vp8", "mpeg4", "prores", "mjpeg", "gif")


@dataclass(frozen=True)
class Check:
    """name, value: as shown. ok: False when something needed is missing. advice: what to do."""

    name: str
    value: str
    ok: bool = True
    advice: str = ""


def doctor() -> None:
    """Check what this machine has, and what is missing."""
    found = list(checks())
    missing = [check for check in found if not check.ok]
    if console.mode.as_json:
        console.emit("doctor", ok=not missing, checks=[asdict(check) for check in found])
    else:
        marks = {True: "ok", False: "MISSING"}
        rows = [(c.name, marks[c.ok], " ".join(filter(None, (c.value, c.advice)))) for c in found]
        console.table(("check", "", "value"), rows)
    if missing:
        raise typer.Exit(int(Family.RESOURCES))


def checks() -> Iterator[Check]:
    """Every check, in the order shown."""
    yield Check(NAME, VERSION)
    yield Check("python", f"{platform.python_version()} on {platform.platform()}")
    yield from map(_library, needed())
    yield Check("threads", f"{threads.count()} of {os.cpu_count()} cores (SPLAT_THREADS sets it)")
    yield Check("OMP_WAIT_POLICY", os.environ.get("OMP_WAIT_POLICY", "not set"))
    yield _memory()
    yield _disk()
    yield _attempted("kernel cache", _kernel_cache)
    yield _attempted("GPU", _gpu, needed=False)
    yield _attempted("photographs read", _photograph_formats)
    yield _attempted("videos read", _video_codecs)
    for backend in BACKENDS:
        yield _backend(backend)
    yield Check("--backend auto", backend_of(AUTO).name)
    yield _attempted("so training", _meaning, needed=False)


def _library(distribution: str) -> Check:
    modules, advice = modules_of(distribution), f"Install {NAME} again: {install_command()}"
    if not modules:
        return Check(distribution, "not installed", ok=False, advice=advice)
    try:
        for module in modules:
            importlib.import_module(module)
    except Exception as error:  # a broken library may raise anything while it loads
        return Check(distribution, reason_of(error), ok=False, advice=advice)
    return Check(distribution, versions().get(distribution, "present"))


def _memory() -> Check:
    free = available_mib()
    enough = free >= _LITTLE_MEMORY_MIB
    advice = "" if enough else "Little: use --preset preview and a smaller --train-side."
    return Check("free memory", console.size(free * MIB), advice=advice)


def _disk() -> Check:
    free = shutil.disk_usage(Path()).free
    advice = "" if free >= _LITTLE_DISK_BYTES else "Little: a run needs about 1 GB."
    return Check("free disk here", console.size(free), advice=advice)


def _attempted(name: str, value: Callable[[], str], needed: bool = True) -> Check:
    """The check whose value is computed; or why that failed, if a library or a driver is missing or
    broken, which may raise anything."""
    try:
        return Check(name, value())
    except Exception as error:
        reason = reason_of(error)
        return Check(name, reason if needed else f"none ({reason})", ok=not needed)


def _kernel_cache() -> str:
    """The folder and its size. Raises if there is no place to write to, or no Numba."""
    own, others = cache.folder(), cache.others()
    value = f"{own}, {console.size(cache.size_bytes(own))}"
    if others:
        value += f"; {counted(len(others), 'other version')} beside it, "
        value += console.size(sum(map(cache.size_bytes, others)))
    return value


def _gpu() -> str:
    """The GPU, also if torch cannot use it."""
    missing = device.missing()
    ready = f"{device.describe()}; its kernels compile in the first run"
    return f"{missing}; {device.built()}" if missing else ready


def _meaning() -> str:
    """Where training happens, and how long it takes there."""
    chosen = backend_of(AUTO)
    if chosen.name != "cpu":
        return f"uses {chosen.name} ({chosen.describe()})"
    slower = 1.0 if _has_avx512() else _WITHOUT_AVX512
    takes = (
        f"about {math.ceil(slower * minutes / threads.count())} min at `{preset}`"
        for preset, minutes in _CPU_MINUTES.items()
    )
    return f"uses the CPU, no GPU: 24 photographs of 640 px take {', '.join(takes)}, a whole run"


def _has_avx512() -> bool:
    from llvmlite import binding  # with Numba, which may be missing

    return bool(binding.get_host_cpu_features().get("avx512f"))


def _photograph_formats() -> str:
    with readers_set_up():
        return ", ".join(name for name in FORMATS if name in Image.OPEN)


def _video_codecs() -> str:
    import av

    return ", ".join(name for name in _VIDEO_CODECS if name in av.codecs_available)


def _backend(backend: Backend) -> Check:
    label = f"backend {backend.name}"
    try:
        if why := backend.why_unavailable():
            with suppress(Exception):  # a software adapter that --backend would take
                why = f"{why}; by name it runs on {backend.describe()}"
            advice = _BACKEND_ADVICE.format(page=backend.name)
            return Check(label, f"not chosen: {why.rstrip('.')}.", advice=advice)
        backend.create()
    except Exception as error:
        return Check(label, f"not present ({reason_of(error)})", ok=False)
    return Check(label, "present")
