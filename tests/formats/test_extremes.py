"""Valid but extreme splats survive every file that claims to hold everything."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.formats.verify import read_back
from stages.measure.images import psnr
from stages.raster import render
from stages.scene import Camera, Splats, look_at
from tests.formats.test_round_trip import read

DEPTH, FOCAL_PX = 4.0, 60.0
PIXEL = DEPTH / FOCAL_PX  # world units that a pixel covers at the depth of the splats


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


TILTED = [0.9, 0.1, -0.2, 0.35]
ROUND = [math.log(3 * PIXEL)] * 3
EXTREMES = {
    "needle of aspect 1e3": one(needle(1e3, 1000), TILTED, [0, 0, 0]),
    "needle of aspect 1e4": one(needle(1e4, 1e4), TILTED, [0, 0, 0]),
    "sigma of 1e-4 px": one([math.log(1e-4 * PIXEL)] * 3, TILTED, [0, 0, 0]),
    **{f"log scale {s}": one([s] * 3, TILTED, [0, 0, 0]) for s in (10, 20, 30, 40)},
    **{
        f"quaternion norm {n:g}": one([-1.0, -3.0, -4.0], [n * v for v in TILTED], [0.3, 0.2, 0.0])
        for n in (1e-19, 1e-10, 1e3, 1e18)
    },
    "beyond the edge of the view": one(ROUND, TILTED, [-3.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("suffix", ["ply", "glb", "usdc"])
def test_an_extreme_splat_draws_the_same_after_a_file(
    tmp_path: Path, suffix: str, name: str
) -> None:
    splats = EXTREMES[name]
    eye = np.array([0.0, 0.0, -DEPTH])
    camera = Camera(48, 36, FOCAL_PX, FOCAL_PX, 24.0, 18.0, look_at(eye, np.zeros(3)))
    formats.write(tmp_path / f"a.{suffix}", splats)
    content = read_back(tmp_path / f"a.{suffix}")
    before = render(splats, camera)
    after = render(content.splats, camera.moved(content.world_from_file))
    assert psnr(after.image, before.image) >= 45
    assert (before.alpha.max() > 0.1) == (after.alpha.max() > 0.1)
    back = read(tmp_path / f"a.{suffix}")
    unit = [
        q[0].astype(float) / np.linalg.norm(q[0].astype(float))
        for q in (splats.quaternions, back.quaternions)
    ]
    apart = min(np.linalg.norm(unit[0] - unit[1]), np.linalg.norm(unit[0] + unit[1]))
    aspect = math.exp(float(np.ptp(splats.log_scales)))
    assert 2 * float(apart) * aspect < 0.5  # radians
