"""Rows 17 and 18: results that depend on nothing but the input."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from stages.base.stage import Report
from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.draw import render
from stages.raster.kernels.pool import Pool
from stages.train import build
from stages.train.loop import train as train_all
from stages.train.settings import TrainSettings
from stages.train.steps.cpu import CpuStep
from tests.extremes.measured import Measured, difference, worst
from tests.scenes import PARAMETERS, camera, cloud, gradients, relative
from tests.small_scene import small_scene
from tests.tolerances import FLOAT32_IMAGE, FLOAT32_SHIFT

THREADS = (1, 2, 3)


def equal_depths(backend):
    """Order: by depth rounded to float32, then by the splats' own values; see `reference`."""
    pictures, slopes, others = [], [], []
    for scene, view in (_wall(), _pile(), _rounded_together()):
        v = np.random.default_rng(3).normal(size=(48, 64, 3)).astype(np.float32)
        order = np.random.default_rng(1).permutation(len(scene))
        shuffled = scene.take(order)
        image, again = (render(s, view, RasterSettings(), backend).image for s in (scene, shuffled))
        pictures.append(difference(again, image))
        a, b = (gradients(backend, s, view, v) for s in (scene, shuffled))
        slopes += [relative(b[name], a[name][order]) for name in PARAMETERS]
        wanted = render(scene, view, RasterSettings(), "reference").image
        others.append(difference(image, wanted))
    found = [
        Measured(17, "image", worst(pictures), FLOAT32_SHIFT),
        Measured(17, "gradients, relative", worst(slopes), FLOAT32_SHIFT),
    ]
    if backend != "reference":
        found.append(Measured(17, "image to the reference", worst(others), FLOAT32_IMAGE))
    return found


def _wall():
    scene = cloud(200, degree=1)
    scene.means[:, 2] = 3.0
    return scene, camera()


def _pile():
    """All in one place; they differ in shape and colour."""
    scene = cloud(120, degree=1, size_px=6.0)
    scene.means[:] = (0.05, -0.03, 3.0)
    return scene, camera()


def _rounded_together():
    """Seen from 2^20 away: depths differ, but float32 knows some 60 of them."""
    away = np.eye(4)
    away[2, 3] = 2.0**20
    scene = cloud(200, degree=1)
    return scene, camera(focal=60 / 4 * 2.0**20, matrix=away)


def same_seed(backend):
    if backend == "cpu":
        drawn = [_drawn(threads) for threads in THREADS]
        trained = [_trained(backend, 120, threads) for threads in THREADS[:2]]
    else:
        drawn = [_drawn_by(backend) for _ in range(2)]
        trained = [_trained(backend, 4, 1) for _ in range(2)]
    assert backend != "cpu" or len(trained[0][0]) > 40  # it grew, which draws random numbers
    return [
        Measured(18, "image and gradients, bytes that differ", _differing(drawn), 0),
        Measured(18, "training, bytes that differ", _differing(trained), 0),
    ]


def _differing(runs):
    """How many bytes of the runs differ from those of the first."""
    return sum(
        int((a.reshape(-1).view(np.uint8) != b.reshape(-1).view(np.uint8)).sum())
        if a.shape == b.shape
        else max(a.size, b.size)
        for run in runs[1:]
        for a, b in zip(runs[0], run, strict=True)
    )


def five_runs(backend):
    drawn = [_drawn_by(backend, 60) for _ in range(5)]
    return [Measured(19, "image and gradients, bytes that differ", _differing(drawn), 0)]


def _drawn_by(backend, n=300):
    """[image, gradients by parameters] of a new rasteriser."""
    scene, view = cloud(n, degree=1), camera(90, 70)
    v = np.random.default_rng(1).normal(size=(70, 90, 3)).astype(np.float32)
    image = render(scene, view, RasterSettings(), backend).image
    slopes = gradients(backend, scene, view, v).values()
    return [image, *map(np.ascontiguousarray, slopes)]


def _drawn(threads):
    """[image, gradients by parameters, by means on the picture] with so many threads."""
    scene, view = cloud(500, degree=1), camera(90, 70)
    v = np.random.default_rng(1).normal(size=(3, 70, 90)).astype(np.float32)
    rasteriser, arrays = CpuRasteriser(Pool(threads)), splat_arrays(scene)
    forward = rasteriser.forward(arrays, view, RasterSettings())
    image = forward.image.copy()
    backward = rasteriser.backward(forward, v)
    return [image, backward.parameters.copy(), backward.means2d.copy()]


def _trained(backend, steps, threads):
    """The arrays of a model trained on a little scene, from photographs in files."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = small_scene(folder, views=5, n=80)
        settings = TrainSettings(
            steps=steps,
            train_side=72,
            sh_degree=1,
            max_splats=300,
            backend=backend,
        )
        start = scene.splats.take(np.arange(0, 80, 2)).with_sh_degree(0)
        trainer = build.make_trainer(scene.reconstruction, start, settings, folder, Report())
        if backend == "cpu":
            trainer.stepper = CpuStep(CpuRasteriser(Pool(threads)))
        model = train_all(trainer, start)
        return [array.copy() for array in vars(model).values()]
