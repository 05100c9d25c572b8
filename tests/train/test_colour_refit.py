"""The refit of colours to all training views."""

from dataclasses import replace

import numpy as np
import pytest

from stages.base.stage import Report
from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings, splat_arrays
from stages.scene import IGNORE, DrawSettings, look_at
from stages.train.camera_refinement import CameraRefinement
from stages.train.colour_refit import ColourRefit
from stages.train.conversion import model_of
from stages.train.hooks import FinalColourRefit
from stages.train.loss import channel_means
from stages.train.optimiser import Model, new_model
from stages.train.schedule import Schedule
from stages.train.views import Level
from tests.scenes import camera, cloud
from tests.train.pictures import trainer_of, view_of

SETTINGS = RasterSettings(sh_degree=1)
NO_WIDTHS = np.zeros(0, np.float32)


@pytest.fixture
def truth() -> Model:
    return new_model(*splat_arrays(cloud(80, 40, 30, degree=1)))


def pictures_of(model: Model) -> list[Level]:
    """Three photographs of `model`, from three sides."""
    found = []
    for x in (-1.0, 0.0, 1.0):
        where = camera(40, 30, matrix=look_at(np.array([x, 0.0, -1.0]), np.array([0.0, 0.0, 5.0])))
        image = CpuRasteriser().forward(model.arrays, where, SETTINGS).image[:3]
        pixels = np.rint(image.clip(0, 1) * 255).astype(np.uint8)
        found.append(Level(where, pixels, channel_means(pixels)))
    return found


def refitted(model: Model, levels: list[Level]) -> Model:
    return ColourRefit(CpuRasteriser(), SETTINGS, lambda: levels).of(model)


def squared_error(model: Model, levels: list[Level]) -> float:
    images = (CpuRasteriser().forward(model.arrays, p.camera, SETTINGS).image[:3] for p in levels)
    return sum(
        float(np.square(image - level.pixels / 255).sum())
        for image, level in zip(images, levels, strict=True)
    )


def paler(model: Model) -> Model:
    return replace(model, sh=(0.5 * model.sh).astype(np.float32))


def test_one_step_takes_out_most_of_what_colours_alone_got_wrong(truth):
    levels = pictures_of(truth)
    before, after = paler(truth), refitted(paler(truth), levels)
    assert squared_error(after, levels) < 0.25 * squared_error(before, levels)


def test_repeated_refits_never_get_worse(truth):
    levels, model = pictures_of(truth), paler(truth)
    errors = [squared_error(model, levels)]
    for _ in range(4):
        model = refitted(model, levels)
        errors.append(squared_error(model, levels))
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("value", [1e10, 3e38])
def test_one_colour_beyond_all_bounds_leaves_the_others_their_refit(truth, value):
    levels, broken = pictures_of(truth), paler(truth)
    wanted = refitted(broken, levels).sh - broken.sh
    broken.sh[7, 0] = value
    found = refitted(broken, levels).sh - broken.sh
    others = np.arange(len(truth)) != 7
    assert np.isfinite(found).all()
    assert np.abs(found[others]).max() > 0.3 * np.abs(wanted).max()


def test_nothing_but_colours_moves(truth):
    after = refitted(paler(truth), pictures_of(truth))
    for name, array in vars(truth).items():
        assert (name == "sh") != np.array_equal(getattr(after, name), array)


def test_coefficients_above_a_splats_own_degree_stay_zero(truth):
    levels, flat = pictures_of(truth), paler(truth)
    flat.sh_degrees[:] = 0
    flat.sh[:, 1:] = 0.0
    assert not refitted(flat, levels).sh[:, 1:].any()


def test_ignored_regions_have_no_influence(truth):
    levels = [
        replace(level, mask=np.zeros((30, 40), np.uint8), outside=IGNORE)
        for level in pictures_of(truth)
    ]
    np.testing.assert_array_equal(refitted(paler(truth), levels).sh, paler(truth).sh)


def test_the_last_refit_is_to_the_refined_cameras(tmp_path, monkeypatch):
    refinement = CameraRefinement.of({name: camera(40, 30) for name in "abc"}, 10.0)
    refinement.poses[:, 0, 3] = 0.5
    views = [view_of(name, np.zeros((30, 40, 3)), camera(40, 30)) for name in "abc"]
    start = cloud(50, 40, 30, degree=0)
    made = trainer_of(
        *(Schedule(100, 10.0, 0, 50, 0), views, [], DrawSettings(near=0.1), 50, tmp_path, Report()),
        backend="cpu",
        refinement=refinement,
    )
    made.stepper.load(model_of(start))
    seen: list[float] = []

    def refit(self, model):
        seen.extend(level.camera.world_to_camera[0, 3] for level in self.levels())
        return model

    monkeypatch.setattr(ColourRefit, "of", refit)
    FinalColourRefit().after_step(made, 100)
    assert seen == [0.5, 0.5, 0.5]


def test_no_photograph_leaves_colours_as_they_are(truth):
    np.testing.assert_array_equal(refitted(truth, []).sh, truth.sh)
