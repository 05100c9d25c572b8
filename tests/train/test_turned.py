"""Training does not depend on how the world lies, nor on its handedness and unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.train.settings import TrainSettings
from tests.benchmarks import turned
from tests.tolerances import TURNED_DB, TURNED_SSIM
from tests.turned_worlds import WORLDS, World

SETTINGS = TrainSettings(steps=400, train_side=160, sh_degree=1, max_splats=8000)
SEEDS = 3


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> turned.Prepared:
    return turned.hall(tmp_path_factory.mktemp("hall"), 160)


def mean_quality(hall: turned.Prepared, world: World) -> tuple[float, float]:
    """(PSNR in dB, SSIM), the mean of SEEDS runs."""
    runs = [turned.quality(hall, world, replace(SETTINGS, seed=seed)) for seed in range(SEEDS)]
    psnr_db, ssim = np.mean(runs, axis=0)
    return float(psnr_db), float(ssim)


@pytest.fixture(scope="module")
def as_it_is(hall: turned.Prepared) -> tuple[float, float]:
    return mean_quality(hall, WORLDS["as it is"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "world",
    ["turned anyhow", "turned otherwise", "quarter turn about z", "mirrored", "in millimetres"],
)
def test_a_turned_mirrored_or_scaled_world_is_learnt_as_well(
    world: str, hall: turned.Prepared, as_it_is: tuple[float, float]
) -> None:
    """With seeds along the world's axes a turned world lost 0.09 to 0.18 dB and 0.01 of SSIM."""
    psnr_db, ssim = mean_quality(hall, WORLDS[world])
    assert psnr_db == pytest.approx(as_it_is[0], abs=TURNED_DB)
    assert ssim == pytest.approx(as_it_is[1], abs=TURNED_SSIM)
