"""Splats that are fine-tuned to what a file format rounds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.base.stage import Report
from stages.evaluate.evaluation import load_evaluation_views, mean_psnr_db
from stages.export import stage as export
from stages.export.settings import ExportSettings
from stages.formats import FORMATS
from stages.formats.axes import smallest_rotations
from stages.formats.sog_quantisation import BitDepths, quantise_splats
from stages.quantise.format_finetuning import FormatFinetuning
from stages.quantise.rounding import finetune_to_rounding, write_and_read
from stages.quantise.settings import QuantiseSettings
from stages.scene import QuantisedSplats, split_held_out, training_extent
from stages.train.finetune import FineTuner
from tests.small_scene import SmallScene, small_scene

FEW = BitDepths(position=9, rotation=4, scale=4, colour=5, opacity=4, palette=5)
ROUNDING = tuple(name for name, row in FORMATS.items() if row.needs_finetuning)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SmallScene:
    return small_scene(tmp_path_factory.mktemp("photos"), noise=0.0)


def views(scene: SmallScene, held_out: bool = False):
    chosen = split_held_out(scene.reconstruction.views)[held_out]
    return load_evaluation_views(scene.reconstruction.folder, chosen, scene.splats.draw_settings)


def finetuner(scene: SmallScene) -> FineTuner:
    return FineTuner(views(scene), training_extent(scene.reconstruction), "cpu", Report())


def no_counts(scene: SmallScene) -> np.ndarray:
    return np.zeros(len(scene.splats), np.int32)


def test_other_attributes_compensate_for_those_that_are_rounded(scene: SmallScene) -> None:
    exact = smallest_rotations(scene.splats)
    found = finetune_to_rounding(
        lambda s: quantise_splats(s, FEW), exact, finetuner(scene), 30, no_counts(scene)
    )
    rounded = write_and_read(FORMATS["sog"], found)
    for name in ("means", "log_scales", "opacity_logits"):
        np.testing.assert_allclose(getattr(rounded, name), getattr(found, name), atol=2e-6)
    for held_out, gain in ((False, 1.0), (True, 0.5)):
        plain, finetuned = (
            mean_psnr_db(splats, views(scene, held_out), "cpu")
            for splats in (quantise_splats(exact, FEW), rounded)
        )
        assert finetuned > plain + gain


@pytest.mark.parametrize("name", ROUNDING)
def test_what_is_read_comes_in_the_order_that_was_written(scene: SmallScene, name: str) -> None:
    read = write_and_read(FORMATS[name], scene.splats)
    assert np.abs(read.means - scene.splats.means).max() < 0.01
    assert np.abs(read.log_scales - scene.splats.log_scales).max() < 0.1
    assert read.sh.shape == scene.splats.sh.shape


def quantised(scene: SmallScene, *names: str) -> tuple[QuantisedSplats, dict[str, dict]]:
    plain = QuantisedSplats(scene.splats, vars(FEW))
    settings = QuantiseSettings(rounding_steps=10, backend="cpu")
    finetuning = FormatFinetuning(
        *(finetuner(scene), finetuner(scene), 0, views(scene), no_counts(scene), settings, Report())
    )
    found = {name: finetuning.to_rounding_of(FORMATS[name], plain) for name in names}
    finetuned = {name: splats for name, (splats, _) in found.items()}
    return replace(plain, finetuned=finetuned), {name: f for name, (_, f) in found.items()}


def test_compact_files_hold_splats_that_were_finetuned_to_them_if_that_helps(
    scene: SmallScene, tmp_path: Path
) -> None:
    decided, figures = quantised(scene, *ROUNDING)
    inputs = {"sfm": scene.reconstruction, "quantise": decided}
    export.run(inputs, ExportSettings(formats=ROUNDING), tmp_path, Report())
    assert figures["sog"]["finetuned_db"] > figures["sog"]["rounded_db"] + 0.5
    for name in ROUNDING:
        held = decided.finetuned[name]
        read = formats.read(tmp_path / f"scene.{name}")
        drawn = mean_psnr_db(
            replace(read, draw_settings=held.draw_settings, origin=held.origin),
            views(scene),
            "cpu",
        )
        assert drawn == pytest.approx(max(figures[name].values()), abs=0.02)


def test_a_file_does_not_depend_on_what_else_is_written(scene: SmallScene) -> None:
    alone, _ = quantised(scene, "sog")
    others, _ = quantised(scene, "splat", "spz", "sog")
    for a, b in zip(alone.finetuned["sog"].arrays, others.finetuned["sog"].arrays, strict=True):
        assert a.tobytes() == b.tobytes()
