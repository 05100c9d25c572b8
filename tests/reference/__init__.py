"""The definition as a backend for tests: 300 times slower than the CPU's.

Importing this package adds it to the lists of backends and of training steps.
"""

from __future__ import annotations

from stages.raster import backends
from stages.raster.backends import Backend
from stages.raster.definition import Rasteriser
from stages.train.steps import step


def _reference() -> Rasteriser:
    # it reads what is still being imported when tests of these lists import this package
    from tests.reference.rasteriser import ReferenceRasteriser

    return ReferenceRasteriser()


if not any(backend.name == "reference" for backend in backends.BACKENDS):
    backends.BACKENDS = (*backends.BACKENDS, Backend("reference", _reference, "torch, slow"))
    step.STEPS["reference"] = "tests.reference.step:ReferenceStep"
