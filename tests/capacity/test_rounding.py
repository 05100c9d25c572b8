"""Splats that are fitted to what a file rounds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages import export, formats
from stages.base.stage import Report
from stages.capacity.rounding import ORDER, as_read, tuned_to
from stages.export import ExportSettings
from stages.formats import FORMATS
from stages.formats.axes import smallest_rotations
from stages.formats.quantisation import BitDepths, quantise_splats
from stages.measure.evaluation import load_evaluation_views, mean_psnr_db
from stages.scene import QuantisedSplats, Splats, TrainedSplats, split_held_out, training_extent
from stages.training.finetune import FineTuner
from tests.small_scene import SmallScene, small_scene

FEW = BitDepths(position=9, rotation=4, scale=4, colour=5, opacity=4, palette=5)
ROUNDING = [name for name, row in FORMATS.items() if row.needs_finetuning]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SmallScene:
    return small_scene(tmp_path_factory.mktemp("photos"), noise=0.0)


def tuner(scene: SmallScene, dropout: bool = False) -> FineTuner:
    return FineTuner(
        photographs(scene), training_extent(scene.reconstruction), "cpu", Report(), dropout
    )


def photographs(scene: SmallScene, held_out: bool = False):
    views = split_held_out(scene.reconstruction.views)[held_out]
    return load_evaluation_views(scene.reconstruction.folder, views, scene.splats.draw_settings)


def nothing_seen(splats: Splats) -> np.ndarray:
    return np.zeros(len(splats), np.int32)


@pytest.mark.parametrize("sits_out", [False, True])
def test_what_stands_still_does_not_change_by_a_bit(scene: SmallScene, dropout: bool) -> None:
    splats, everything = scene.splats, set(ORDER)
    for moving in ORDER:
        still = everything - {moving}
        found = tuner(scene, dropout).finetune(splats, 3, nothing_seen(splats), still)
        same = {
            "means": np.array_equal(found.means, splats.means),
            "quaternions": np.array_equal(found.quaternions, splats.quaternions),
            "log_scales": np.array_equal(found.log_scales, splats.log_scales),
            "opacity_logits": np.array_equal(found.opacity_logits, splats.opacity_logits),
            "sh_dc": np.array_equal(found.sh[:, 0], splats.sh[:, 0]),
            "sh_rest": np.array_equal(found.sh[:, 1:], splats.sh[:, 1:]),
        }
        assert {name for name, is_same in same.items() if is_same} == still


def test_the_others_make_up_for_what_is_rounded(scene: SmallScene) -> None:
    exact = smallest_rotations(scene.splats)
    found = tuned_to(
        lambda s: quantise_splats(s, FEW), exact, tuner(scene), 30, nothing_seen(scene.splats)
    )
    rounded = as_read(FORMATS["sog"], found)
    for name in ("means", "log_scales", "opacity_logits"):
        np.testing.assert_allclose(getattr(rounded, name), getattr(found, name), atol=2e-6)
    for held_out, gain in ((False, 1.0), (True, 0.5)):
        plain, fitted = (
            mean_psnr_db(splats, photographs(scene, held_out), "cpu")
            for splats in (quantise_splats(exact, FEW), rounded)
        )
        assert fitted > plain + gain


@pytest.mark.parametrize("name", ROUNDING)
def test_what_is_read_comes_in_the_order_that_was_written(scene: SmallScene, name: str) -> None:
    read = as_read(FORMATS[name], scene.splats)
    assert np.abs(read.means - scene.splats.means).max() < 0.01
    assert np.abs(read.log_scales - scene.splats.log_scales).max() < 0.1
    assert read.sh.shape == scene.splats.sh.shape


def exported(scene: SmallScene, folder: Path, **settings) -> dict[str, dict]:
    report = Report()
    inputs = {
        "sfm": scene.reconstruction,
        "train": TrainedSplats(scene.splats),
        "quantise": QuantisedSplats(scene.splats, 2, {"bits": vars(FEW)}),
    }
    folder.mkdir()
    export.run(inputs, ExportSettings(**settings), folder, report)
    return report.metrics["formats"]


def test_compact_files_hold_splats_that_were_fitted_to_them_if_that_helps(
    scene: SmallScene, tmp_path: Path
) -> None:
    wanted = ("ply", *ROUNDING)
    fitted = exported(scene, tmp_path / "fitted", formats=wanted, rounding_steps=10)
    plain = exported(scene, tmp_path / "plain", formats=wanted, rounding_steps=0)
    assert export.fitted_in(tmp_path / "fitted", "ply") is None
    assert fitted["sog"]["fitted_db"] > fitted["sog"]["plain_db"] + 0.5
    for name in ROUNDING:
        assert "fitted_db" not in plain[name]
        held = export.fitted_in(tmp_path / "fitted", name)
        assert held is not None
        assert export.fitted_in(tmp_path / "plain", name) is None
        read = formats.read(tmp_path / "fitted" / f"scene.{name}")
        drawn = mean_psnr_db(
            replace(read, draw_settings=scene.splats.draw_settings, origin=held.origin),
            photographs(scene),
            "cpu",
        )
        better = max(fitted[name]["plain_db"], fitted[name]["fitted_db"])
        assert drawn == pytest.approx(better, abs=0.02)


def test_a_file_does_not_depend_on_what_else_is_written(scene: SmallScene, tmp_path: Path) -> None:
    exported(scene, tmp_path / "alone", formats=("sog",), rounding_steps=10)
    exported(scene, tmp_path / "others", formats=("splat", "spz", "sog"), rounding_steps=10)
    alone, others = (tmp_path / name / "scene.sog" for name in ("alone", "others"))
    assert alone.read_bytes() == others.read_bytes()
