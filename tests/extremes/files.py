"""Row 29: valid but extreme splats survive every file that claims to hold everything."""

from __future__ import annotations

import functools
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages import formats
from stages.formats import usd_read
from stages.proof.checks import read_back
from stages.proof.content import FileContent
from stages.raster.definition import RasterSettings, Rendering
from stages.raster.draw import render
from stages.scene import Camera, Splats, look_at
from tests.extremes.measured import Measured, worst
from tests.scenes import join
from tests.tolerances import ASPECT_TIMES_ANGLE, EIGHT_BIT_ANGLE, RMS_45_DB

# Those that claim to hold everything, and .splat; the packed ones have bounds of their own in
# tests/formats.
KEPT_FORMATS = [f for f, row in formats.FORMATS.items() if f == "splat" or not row.loses]
DEPTH, FOCAL_PX = 4.0, 60.0
PIXEL = DEPTH / FOCAL_PX  # world units that a pixel covers at the depth of the splats
EIGHT_BIT_COLOUR = ".splat holds colours of 8 bits that do not change with the view"
EIGHT_BIT_TURN = ".splat holds 8 bits of each component of a rotation"


def one(log_scales: list[float], quaternion: list[float], mean: list[float]) -> Splats:
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 0] = (1.2, -0.4, 0.3)
    sh[0, 1:] = 0.2
    return Splats(
        means=np.array([mean], np.float32),
        quaternions=np.array([quaternion], np.float32),
        log_scales=np.array([log_scales], np.float32),
        opacity_logits=np.array([1.5], np.float32),
        sh=sh,
        sh_degrees=np.ones(1, np.uint8),
    )


def needle(aspect: float, sigma_px: float) -> list[float]:
    long = sigma_px * PIXEL
    return [math.log(long), math.log(long / aspect), math.log(long / aspect)]


def beside_culled(*culled: Splats) -> Splats:
    """Rows that cannot be drawn, ahead of one that can."""
    return join(*culled, one([-1.0, -3.0, -4.0], TILTED, [0.3, 0.2, 0.0]))


TILTED = [0.9, 0.1, -0.2, 0.35]
ROUND = [math.log(3 * PIXEL)] * 3
EXTREMES = {
    "needle of aspect 1e3": one(needle(1e3, 1000), TILTED, [0, 0, 0]),
    "needle of aspect 1e4": one(needle(1e4, 1e4), TILTED, [0, 0, 0]),
    "sigma of 1e-4 px": one([math.log(1e-4 * PIXEL)] * 3, TILTED, [0, 0, 0]),
    **{f"log scale {s}": one([s] * 3, TILTED, [0, 0, 0]) for s in (10, 20, 30, 40)},
    "log scales out of range": beside_culled(
        *(one([s, -1.0, -1.0], TILTED, [0, 0, 0]) for s in (45.0, 89.0, np.inf, np.nan))
    ),
    "quaternions too short": beside_culled(
        *(one(ROUND, [n * v for v in TILTED], [0, 0, 0]) for n in (0.0, 1e-23))
    ),
    **{
        f"quaternion norm {n:g}": one([-1.0, -3.0, -4.0], [n * v for v in TILTED], [0.3, 0.2, 0.0])
        for n in (1e-19, 1e-10, 1e3, 1e18)
    },
    "beyond the edge of the view": one(ROUND, TILTED, [-3.0, 0.0, 0.0]),
}
EYE = np.array([0.0, 0.0, -DEPTH])
CAMERA = Camera(48, 36, FOCAL_PX, FOCAL_PX, 24.0, 18.0, look_at(EYE, np.zeros(3)))


@dataclass(frozen=True)
class Written:
    """dropped: by the writer. content: by a reader that shares no code with it. back: by ours."""

    dropped: int
    content: FileContent
    back: Splats


@functools.cache
def written(suffix: str, name: str) -> Written:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{suffix}"
        dropped = formats.write(path, EXTREMES[name])
        # as `formats.read`, without the process that it starts for USD
        back = usd_read.parse(path) if suffix.startswith("usd") else formats.read(path)
        return Written(dropped, read_back(path), back)


def through_a_file(backend: str, suffix: str, name: str) -> list[Measured]:
    """One splat of `EXTREMES` (with what cannot be drawn ahead of it) and one format."""
    splats, file = EXTREMES[name], written(suffix, name)
    before, after = _drawn(backend, splats), _drawn_from(backend, file)
    wrong = abs(file.dropped - before.culled) + after.culled
    wrong += abs(len(file.back) - 1) + abs(len(file.content.splats) - 1)
    wrong += int((before.alpha.max() > 0.1) != (after.alpha.max() > 0.1))
    turn = turned_by(splats, file.back)
    reach = turn * math.exp(float(np.ptp(splats.log_scales[-1])))
    lossy = suffix == "splat"
    notes = (EIGHT_BIT_COLOUR, EIGHT_BIT_TURN) if lossy else ("", "")
    found = [
        Measured(29, f".{suffix}: lost, kept or dropped wrongly", wrong, 0),
        Measured(29, f".{suffix}: image, rms", rms(after, before), RMS_45_DB, notes[0]),
        Measured(29, f".{suffix}: aspect x angle, rad", reach, ASPECT_TIMES_ANGLE, notes[1]),
    ]
    if lossy:
        plain = rms(after, _drawn(backend, splats.with_sh_degree(0)))
        found += [
            Measured(29, f".{suffix}: image to one of constant colour, rms", plain, RMS_45_DB),
            Measured(29, f".{suffix}: angle, rad", turn, EIGHT_BIT_ANGLE),
        ]
    return found


def _drawn(backend: str, splats: Splats) -> Rendering:
    return render(splats, CAMERA, RasterSettings(), backend)


def _drawn_from(backend: str, file: Written) -> Rendering:
    moved = CAMERA.moved(file.content.world_from_file)
    return render(file.content.splats, moved, RasterSettings(), backend)


def rms(after: Rendering, before: Rendering) -> float:
    apart = after.image.astype(np.float64) - before.image
    return float(np.sqrt(np.mean(apart * apart)))


def turned_by(splats: Splats, back: Splats) -> float:
    """Angle (rad) between the last of `splats` and the only one that came back."""
    a, b = (q.astype(float) for q in (splats.quaternions[-1], back.quaternions[0]))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return 2 * float(min(np.linalg.norm(a - b), np.linalg.norm(a + b)))


def every_format(backend: str) -> list[Measured]:
    """The worst scene of each format."""
    found: dict[str, list[Measured]] = {}
    for suffix in KEPT_FORMATS:
        for name in EXTREMES:
            for m in through_a_file(backend, suffix, name):
                found.setdefault(m.what, []).append(m)
    return [
        Measured(29, what, worst(m.error for m in ms), ms[0].bound, ms[0].note)
        for what, ms in found.items()
    ]
