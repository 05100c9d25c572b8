"""Cameras that are nearly right, with and without `--refine-in-training`:
`python -m tests.benchmarks.shaken_cameras RUN [--steps N --side PX]`.

The cameras of a run's training views are moved at random, or all focal lengths are changed.
Held-out views keep their poses; with refinement they are registered to the splats before they are
compared, as the stage does.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stages.base.stage import Report
from stages.run.pipeline import Pipeline
from stages.run.stages import STAGE_OF
from stages.scene import Reconstruction, View, split_held_out, training_extent
from stages.train.settings import TrainSettings

# (mean distance of the moves in extents of the scene, factor of the focal lengths)
CASES = ((0.0, 1.0), (0.001, 1.0), (0.005, 1.0), (0.02, 1.0), (0.0, 1.01))


def shaken(reconstruction: Reconstruction, size: float, focal: float) -> Reconstruction:
    """With training cameras moved by about `size` extents and turned by a third of that (radians),
    and all focal lengths times `focal`."""
    rng, extent = np.random.default_rng(5), training_extent(reconstruction)
    training = split_held_out(reconstruction.views)[0]

    def changed(view: View) -> View:
        camera, move = view.camera, np.eye(4)
        if view in training:
            turn = rng.normal(0, size / 3 / np.sqrt(3), 3)
            move[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
            move[:3, 3] = rng.normal(0, size / np.sqrt(3), 3) * extent
        pose = move @ camera.world_to_camera
        lens = camera.fx * focal, camera.fy * focal
        return replace(view, camera=replace(camera, fx=lens[0], fy=lens[1], world_to_camera=pose))

    return replace(reconstruction, views=tuple(changed(view) for view in reconstruction.views))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--side", type=int, default=480)
    parser.add_argument("--max-splats", type=int, default=60_000)
    given = parser.parse_args()
    pipeline = Pipeline(given.run)
    reconstruction, seeds = pipeline.load("sfm"), pipeline.load("seed")
    settings = TrainSettings(
        given.steps, given.side, sh_degree=1, max_splats=given.max_splats, backend="cpu"
    )
    print("moved (extents) | focal factor | as given, dB | refined, dB | moved back | focal factor")
    for size, focal in CASES:
        inputs = {"sfm": shaken(reconstruction, size, focal), "seed": seeds}
        found = []
        for refine in (False, True):
            report = Report()
            asked = replace(settings, refine_in_training=refine)
            with tempfile.TemporaryDirectory() as folder:
                STAGE_OF["train"].run(inputs, asked, Path(folder), report)
            found.append(report.metrics)
        before, after = found
        extent = training_extent(reconstruction)
        print(
            f"{size:g} | {focal:g} | {before['psnr_db']:.2f} | {after['psnr_db']:.2f} | "
            f"{after['cameras_moved'] / extent:.4f} | {after['focal_factor'] * focal:.4f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
