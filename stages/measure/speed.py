"""How fast splats are drawn."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.measure.evaluation import image_renderer
from stages.scene import Camera, Splats

_TRIES = 3


def seconds_per_frame(
    splats: Splats, cameras: Sequence[Camera], backend: str
) -> NDArray[np.float64]:
    """[cameras] seconds that each picture takes, once kernels and buffers are there: the least of
    a few tries, which a machine's other work disturbs least."""
    draw = image_renderer(splats, backend)
    draw(cameras[0])
    seconds = np.full(len(cameras), np.inf)
    for _ in range(_TRIES):
        for i, camera in enumerate(cameras):
            begun = time.perf_counter()
            draw(camera)
            seconds[i] = min(seconds[i], time.perf_counter() - begun)
    return seconds
