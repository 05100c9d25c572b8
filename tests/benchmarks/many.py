"""Memory with many photographs: `python -m tests.benchmarks.many [--photographs 1000]`.

Trains for a few steps on as many photographs of 1600 px, copies of a few of the sample's, which are
decoded once each; looks at all the others, as training does in a round; and prints how much memory
the process took beyond what it held before they were loaded.
"""

from __future__ import annotations

import argparse
import functools
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from sample_captures.make import HERE
from stages.base.memory import PeakMemory, resident_mib
from stages.evaluate.evaluation import EvaluationView, load_evaluation_view, load_evaluation_views
from stages.raster.definition import RasterSettings
from stages.scene import Camera, DrawSettings, View
from stages.train import views as training_views
from stages.train.optimiser import LearningRates, new_model
from stages.train.steps.step import StepInput, step_of
from stages.train.views import load_views
from tests.scenes import camera, cloud

SIZE = (1600, 1200)
SPLATS, STEPS = 2000, 10


def pictures(folder: Path) -> list[str]:
    """A few of the sample's photographs, enlarged."""
    names = []
    for path in sorted((HERE / "still_life" / "images").glob("*.jpg"))[:4]:
        large = cv2.resize(np.asarray(cv2.imread(str(path))), SIZE, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / path.name), large)
        names.append(path.name)
    return names


@functools.cache
def _decoded(folder: Path, image: str, width: int, height: int) -> EvaluationView:
    where = camera(width, height)
    return load_evaluation_view(folder, View(image, image, where), where)


def _decoded_once(folder: Path, view: View, where: Camera) -> EvaluationView:
    return _decoded(folder, view.image, where.width, where.height)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photographs", type=int, default=1000)
    count = parser.parse_args().photographs
    where = camera(*SIZE)
    model = new_model(*(np.array(a, np.float32) for a in cloud(SPLATS, *SIZE).arrays))
    stepper = step_of("cpu")
    stepper.load(model)
    setattr(training_views, "load_photograph", _decoded_once)  # noqa: B010 - not exported from there
    with tempfile.TemporaryDirectory(dir=Path.home()) as name:
        folder = Path(name)
        files = pictures(folder)
        views = tuple(View(f"{i:04d}", files[i % len(files)], where) for i in range(count))
        before = resident_mib()
        with PeakMemory() as memory:
            begun = time.monotonic()
            train = load_views(folder, views[: count * 7 // 8], max(SIZE), folder)
            held_out = load_evaluation_views(
                folder, views[count * 7 // 8 :], DrawSettings(0.1, max(SIZE))
            )
            print(f"{len(train)} + {len(held_out)} photographs: {time.monotonic() - begun:.0f} s")
            order = np.random.default_rng(0).permutation(len(train))
            for number in order[:STEPS]:
                level = train[number].levels[-1]
                stepper.step(StepInput(level, RasterSettings(near=0.1), LearningRates()))
            touched = sum(int(view.levels[-1].pixels.max()) > 0 for view in train)
        print(f"{touched} photographs used; {memory.peak_mib - before:.0f} MiB beyond the splats")


if __name__ == "__main__":
    main()
