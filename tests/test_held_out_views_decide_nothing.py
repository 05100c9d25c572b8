"""No pixel of a held-out view reaches the asset, and a photograph with a duplicate is not held out.

Structure from motion registers held-out views too, so it sees all photographs.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.base.stage import Report
from stages.export.settings import ExportSettings
from stages.prune.settings import PruneSettings
from stages.quantise.settings import QuantiseSettings
from stages.run.stages import STAGE_OF
from stages.scene import Reconstruction, View, split_held_out
from stages.seed.settings import SeedSettings
from stages.train.settings import TrainSettings
from tests.scenes import camera
from tests.small_scene import small_scene


@pytest.fixture(scope="module")
def reconstruction(tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    """Ten photographs, and a sparse cloud where the splats that they were drawn from are."""
    scene = small_scene(tmp_path_factory.mktemp("photographs"))
    count = len(scene.splats)
    return replace(
        scene.reconstruction,
        points=scene.splats.means.astype(np.float64),
        colours=np.full((count, 3), 128, np.uint8),
        errors_px=np.full(count, 0.5),
        tracks=np.full(count, 5, np.int32),
    )


def made(reconstruction: Reconstruction, folder: Path) -> dict[str, bytes]:
    """By name, the bytes of all that the stages from seed to export leave but figures."""
    inputs = {"sfm": reconstruction}
    stages = (
        (STAGE_OF["seed"], SeedSettings()),
        (STAGE_OF["train"], TrainSettings(steps=120, train_side=72, sh_degree=1, max_splats=400)),
        (STAGE_OF["prune"], PruneSettings()),
        (STAGE_OF["quantise"], QuantiseSettings(formats=("spz",))),
        (STAGE_OF["export"], ExportSettings(formats=("ply", "spz"))),
    )
    found = {}
    for stage, settings in stages:
        place = folder / stage.name
        place.mkdir(parents=True)
        inputs[stage.name] = stage.run(inputs, settings, place, Report())
        for path in place.rglob("*"):
            if path.is_file() and (path.name == "splats.bin" or stage.name == "export"):
                found[path.relative_to(folder).as_posix()] = path.read_bytes()
    return found


@pytest.mark.slow
def test_no_pixel_of_a_held_out_view_reaches_the_asset(
    reconstruction: Reconstruction, tmp_path: Path
) -> None:
    other = tmp_path / "photographs"
    shutil.copytree(reconstruction.folder, other)
    training, held_out = split_held_out(reconstruction.views)
    assert held_out
    noise = np.random.default_rng(0)
    for view in held_out:
        with Image.open(other / view.image) as picture:
            pixels = noise.integers(0, 256, (picture.height, picture.width, 3), np.uint8)
        Image.fromarray(pixels).save(other / view.image)
    wanted = made(reconstruction, tmp_path / "a")
    assert made(replace(reconstruction, folder=other), tmp_path / "b") == wanted
    # and the same change to one photograph of training is seen
    Image.fromarray(pixels).save(other / training[0].image)
    assert made(replace(reconstruction, folder=other), tmp_path / "c") != wanted


def views(*twins: str) -> tuple[View, ...]:
    return tuple(
        View(f"{i:02d}", f"{i:02d}", camera(), duplicate_of) for i, duplicate_of in enumerate(twins)
    )


def test_the_first_of_every_eight_is_held_out() -> None:
    training, held_out = split_held_out(views(*[""] * 17))
    assert [view.name for view in held_out] == ["00", "08", "16"]
    assert len(training) == 14


def test_a_photograph_with_a_duplicate_is_not_held_out() -> None:
    training, held_out = split_held_out(views("00", "00", *[""] * 6, *["08"] * 8))
    assert [view.name for view in held_out] == ["02"]
    assert len(training) == 15


def test_where_all_have_duplicates_they_are_held_out_with_them() -> None:
    twins = [f"{i - i % 2:02d}" for i in range(24)]  # every view was shot twice
    training, held_out = split_held_out(views(*twins))
    assert [view.name for view in held_out] == ["00", "01", "16", "17"]
    assert not {view.duplicate_of for view in training} & {view.duplicate_of for view in held_out}


def test_three_photographs_are_too_few_to_spare_one() -> None:
    assert split_held_out(views("", "", ""))[1] == ()
