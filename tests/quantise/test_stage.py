"""What is kept at which precision, and what it costs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages.base.errors import Family, SplatError
from stages.base.settings import check_settings
from stages.base.stage import Earlier, Report
from stages.evaluate.evaluation import load_evaluation_views, mean_psnr_db
from stages.evaluate.sh import sufficient_degrees, truncate_sh, truncation_rms
from stages.formats.format_table import FORMATS
from stages.formats.sog_quantisation import splats_to_write
from stages.quantise import stage as quantise
from stages.quantise.format_finetuning import FormatFinetuning
from stages.quantise.settings import QuantiseSettings
from stages.scene import (
    IGNORE,
    PrunedSplats,
    QuantisedSplats,
    TrainedSplats,
    dc_to_rgb,
    split_held_out,
)
from tests.formats.truth import colour, many_splats
from tests.small_scene import SmallScene, small_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SmallScene:
    return small_scene(tmp_path_factory.mktemp("photos"))


def decide(
    scene: SmallScene, folder: Path, **settings: Any
) -> tuple[QuantisedSplats, dict[str, Any]]:
    report = Report()
    inputs = {
        "sfm": scene.reconstruction,
        "train": TrainedSplats(scene.splats),
        "prune": PrunedSplats(scene.splats),
    }
    chosen = QuantiseSettings(**{"rounding_steps": 0, **settings})
    result = quantise.run(inputs, chosen, folder, report)
    return result, report.metrics


def test_matt_splats_lose_their_sh_degrees_and_shiny_ones_keep_them(
    scene: SmallScene, tmp_path: Path
) -> None:
    result, metrics = decide(scene, tmp_path)
    shiny = np.arange(len(scene.splats)) % 10 == 0
    assert result.splats.sh_degree == 2
    assert (result.splats.sh_degrees[~shiny] == 0).all()
    assert result.splats.sh_degrees[shiny].mean() > 1
    assert metrics["psnr_raw_db"] - metrics["psnr_kept_db"] < 0.02
    assert metrics["splats_by_sh_degree"][0] == (~shiny).sum()
    assert metrics["kept_mib"] == metrics["raw_mib"]
    assert result.splats.sh_degrees.tolist() == [
        int(np.sqrt(np.flatnonzero(row.any(axis=1)).max(initial=0))) for row in result.splats.sh
    ]


def test_held_out_views_without_a_pixel_that_counts_are_in_no_figure(
    scene: SmallScene, tmp_path: Path
) -> None:
    """Masks leave nothing of both; or too little for a pixel at a quarter of the size."""
    line = np.zeros((54, 72), np.uint8)
    line[20:22] = 255
    held_out = {view.name for view in split_held_out(scene.reconstruction.views)[1]}
    for mask, measured_on in ((np.zeros_like(line), "training"), (line, "held out")):
        Image.fromarray(mask).save(tmp_path / "mask.png")
        views = tuple(
            replace(view, mask=str(tmp_path / "mask.png"), outside=IGNORE)
            if view.name in held_out
            else view
            for view in scene.reconstruction.views
        )
        masked = replace(scene, reconstruction=replace(scene.reconstruction, views=views))
        _, metrics = decide(masked, tmp_path)
        assert metrics["measured_on"] == measured_on
        assert all(metrics[name] > 20 for name in metrics if name.startswith("psnr_kept"))
        assert ("psnr_kept_quarter_db" in metrics) == (measured_on == "training")


def test_the_cost_of_8_bits_without_view_dependence_is_reported(
    scene: SmallScene, tmp_path: Path
) -> None:
    _, metrics = decide(scene, tmp_path)
    assert 25 < metrics["psnr_splat32_db"] < metrics["psnr_raw_db"] - 0.05
    assert 32 < metrics["psnr_raw_db"] < 36  # noise of 0.02 is 34.0 dB
    assert metrics["psnr_kept_quarter_db"] < metrics["psnr_kept_db"]  # splats thicken


def test_a_scene_without_view_dependence_keeps_sh_degree_0(
    scene: SmallScene, tmp_path: Path
) -> None:
    matt = replace(scene.splats.with_sh_degree(0).with_sh_degree(2))
    flat = SmallScene(matt, scene.reconstruction)
    result, metrics = decide(flat, tmp_path)
    assert result.splats.sh_degree == metrics["sh_degree"] == 0
    # 14 numbers instead of 38
    assert metrics["kept_mib"] == pytest.approx(metrics["raw_mib"] * 14 / 38, abs=2e-3)


def test_no_allowance_keeps_what_shows(scene: SmallScene, tmp_path: Path) -> None:
    result, metrics = decide(scene, tmp_path, sh_loss_db=0.0)
    assert metrics["psnr_kept_db"] >= metrics["psnr_raw_db"]
    assert result.splats.sh_degree == 2


def test_a_large_allowance_keeps_nothing(scene: SmallScene, tmp_path: Path) -> None:
    assert decide(scene, tmp_path, sh_loss_db=50.0)[0].splats.sh_degree == 0


def test_the_same_inputs_give_the_same_bytes_and_load_gives_the_output(
    scene: SmallScene, tmp_path: Path
) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    contents = []
    for folder in folders:
        folder.mkdir()
        result, _ = decide(scene, folder, formats=("sog", "splat"), rounding_steps=2)
        files = [path for path in folder.rglob("*") if path.is_file()]
        contents.append({path.relative_to(folder): path.read_bytes() for path in files})
    assert contents[0] == contents[1]
    loaded = quantise.load(folders[0])
    np.testing.assert_array_equal(loaded.splats.sh, result.splats.sh)
    assert loaded.sog_bits == result.sog_bits is not None
    assert set(loaded.finetuned) == {"splat", "sog"}
    for name, splats in loaded.finetuned.items():
        np.testing.assert_array_equal(splats.means, result.finetuned[name].means)


def test_a_format_that_does_not_round_changes_no_setting() -> None:
    assert QuantiseSettings(formats=("ply", "sog", "mesh", "splat")) == QuantiseSettings(
        formats=("splat", "usdc", "sog", "glb")
    )
    assert QuantiseSettings(formats=("html", "mesh")).formats == ()
    assert QuantiseSettings(formats=("sog", "splat")) == QuantiseSettings(formats=("splat", "sog"))
    check_settings(QuantiseSettings(formats=("ply",)))
    with pytest.raises(SplatError, match="--format ksplat"):
        check_settings(QuantiseSettings(formats=("ply", "ksplat")))


def test_formats_that_are_drawn_plainly_get_splats_that_were_finetuned_to_it(
    scene: SmallScene, tmp_path: Path
) -> None:
    small = replace(scene.splats, log_scales=scene.splats.log_scales - 1).with_antialias(True)
    antialiased = SmallScene(small, scene.reconstruction)
    result, metrics = decide(antialiased, tmp_path, formats=("glb",))
    assert result.plain is not None
    assert splats_to_write(FORMATS["glb"], result) is result.plain
    assert not result.plain.draw_settings.antialias
    assert splats_to_write(FORMATS["html"], result) is result.splats
    assert result.splats.draw_settings.antialias
    views = split_held_out(scene.reconstruction.views)[1]
    held_out = load_evaluation_views(scene.reconstruction.folder, views, small.draw_settings)
    as_they_are_db = mean_psnr_db(result.splats.with_antialias(False), held_out, "cpu")
    assert metrics["psnr_plain_db"] > as_they_are_db + 1
    change_db = metrics["psnr_plain_db"] - metrics["psnr_kept_db"]
    assert metrics["plain_drawing_change_db"] == pytest.approx(change_db, abs=1e-3)
    assert quantise.load(tmp_path).plain is not None


@pytest.mark.parametrize(
    ("trained", "asked", "made"), [(0, 0, 200), (2000, 0, 200), (30000, 0, 3000), (30000, 7, 7)]
)
def test_the_longer_training_was_the_longer_splats_are_finetuned_to_plain_drawing(
    scene: SmallScene, trained: int, asked: int, made: int
) -> None:
    training, settings = TrainedSplats(scene.splats, steps=trained), QuantiseSettings()
    finetuning = FormatFinetuning.of(
        scene.splats,
        scene.reconstruction,
        training,
        replace(settings, plain_steps=asked),
        (),
        Report(),
    )
    assert finetuning.plain_steps == made


def test_a_large_loss_by_plain_drawing_is_a_warning(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    splats = scene.splats.with_antialias(True)
    inputs = {
        "sfm": scene.reconstruction,
        "train": TrainedSplats(splats),
        "prune": PrunedSplats(splats),
    }
    settings = QuantiseSettings(formats=("ply",), plain_steps=1, rounding_steps=0)
    for large_db, warned in ((0.1, ["quantise-plain-drawing"]), (1.0, [])):
        monkeypatch.setattr(quantise, "_PLAIN_LOSS_DB", large_db)
        report = Report()
        quantise.run(inputs, settings, tmp_path, report)
        assert [code for code, _ in report.warnings] == warned


@pytest.mark.parametrize(
    ("antialias", "settings"),
    [
        (False, {"formats": ("ply", "splat")}),
        (True, {"formats": ("html",)}),
        (True, {"formats": ("ply",), "drawing": "antialiased"}),
    ],
)
def test_nothing_is_finetuned_to_plain_drawing_without_need(
    antialias: bool, settings: dict[str, Any], scene: SmallScene, tmp_path: Path
) -> None:
    splats = scene.splats.with_antialias(antialias)
    result, _ = decide(SmallScene(splats, scene.reconstruction), tmp_path, **settings)
    assert result.plain is None


def test_the_report_says_what_finetuning_to_a_format_gained(
    scene: SmallScene, tmp_path: Path
) -> None:
    result, metrics = decide(scene, tmp_path, rounding_steps=5)
    assert set(result.finetuned) == set(metrics["formats"]) == {"splat"}
    assert set(metrics["formats"]["splat"]) == {"rounded_db", "finetuned_db"}


def test_without_held_out_views_the_training_views_are_measured(
    tmp_path: Path, scene: SmallScene
) -> None:
    few = replace(scene.reconstruction, views=scene.reconstruction.views[:3])
    _, metrics = decide(SmallScene(scene.splats, few), tmp_path)
    assert metrics["measured_on"] == "training"


def test_splats_that_cannot_be_drawn_do_not_stop_it(scene: SmallScene, tmp_path: Path) -> None:
    bad = scene.splats.take(np.arange(len(scene.splats)))
    bad.sh[3] = np.nan
    bad.means[4] = np.inf
    result, metrics = decide(SmallScene(bad, scene.reconstruction), tmp_path)
    _, clean = decide(scene, tmp_path)
    assert metrics["psnr_kept_db"] == pytest.approx(
        clean["psnr_kept_db"], abs=3
    )  # two of 250 missing
    assert len(result.splats) == len(bad)


def test_no_splats_at_all_do_not_stop_it(scene: SmallScene, tmp_path: Path) -> None:
    nothing = scene.splats.take(np.zeros(len(scene.splats), bool))
    assert decide(SmallScene(nothing, scene.reconstruction), tmp_path)[0].splats.sh_degree == 0


def test_a_missing_photograph_is_named(scene: SmallScene, tmp_path: Path) -> None:
    moved = replace(scene.reconstruction, folder=tmp_path)
    with pytest.raises(SplatError) as caught:
        decide(SmallScene(scene.splats, moved), tmp_path)
    assert "01.png" in caught.value.given  # the first that training has


def test_a_damaged_decision_is_an_error_of_the_run_folder(
    scene: SmallScene, tmp_path: Path
) -> None:
    decide(scene, tmp_path)
    (tmp_path / "decisions.json").write_text('{"sh_degree": ')
    with pytest.raises(SplatError) as caught:
        quantise.load(tmp_path)
    assert caught.value.family == Family.RUN_FOLDER


def test_truncation_rms_is_what_colours_lose_over_all_directions() -> None:
    splats = many_splats(4)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20000, 3))
    sh = splats.sh[3].astype(float)
    for degree in (1, 2, 3):
        tail = sh.copy()
        tail[: degree * degree] = 0
        channel = np.square(tail).max(axis=1)  # the bound takes the worst channel of each term
        seen = np.array([colour(tail, d) - 0.5 for d in directions[:4000]])
        measured = np.sqrt(np.mean(seen**2, axis=0)).max()
        rms = truncation_rms(splats)[3, degree - 1]
        assert rms == pytest.approx(np.sqrt(channel.sum() / (4 * np.pi)), rel=1e-6)
        assert 0.97 * measured <= rms <= 2.0 * measured


def test_truncation_drops_whole_degrees_and_no_others() -> None:
    splats = many_splats()
    degrees = sufficient_degrees(splats, 0.1)
    assert (degrees <= splats.sh_degrees).all()
    after = truncate_sh(splats, degrees)
    for i in range(0, len(splats), 7):
        kept = (int(degrees[i]) + 1) ** 2
        np.testing.assert_array_equal(after.sh[i, :kept], splats.sh[i, :kept])
        assert not after.sh[i, kept:].any()


def test_colours_without_view_dependence_are_the_means_of_what_is_seen(
    scene: SmallScene, tmp_path: Path
) -> None:
    result, _ = decide(scene, tmp_path)
    shiny = result.splats.sh_degrees > 0
    assert result.flat_dc is not None
    moved = np.abs(result.flat_dc - result.splats.sh[:, 0]).max(axis=1)
    assert (moved[shiny] > 1e-3).mean() > 0.5
    dark = dc_to_rgb(result.splats.sh[:, 0]) == 0  # a colour below 0 is drawn, and averaged, as 0
    assert moved[~shiny & ~dark.any(axis=1)].max() < 1e-4
    loaded = quantise.load(tmp_path)
    np.testing.assert_array_equal(loaded.flat_dc, result.flat_dc)


def test_a_sog_gets_no_more_bits_than_its_views_show(scene: SmallScene, tmp_path: Path) -> None:
    for name, allowed in (("a", 0.02), ("b", 2.0)):
        (tmp_path / name).mkdir()
        settings = {"formats": ("sog",), "rounding_steps": 0, "sog_loss_db": allowed}
        _, metrics = decide(scene, tmp_path / name, **settings)
        kept = json.loads((tmp_path / name / "decisions.json").read_text())
        assert kept["bits"] == metrics["bits"]
    fewest = metrics["bits"]
    assert fewest["position"] < 16
    assert all(fewest[name] < 8 for name in ("rotation", "scale", "colour", "opacity"))


def test_bits_are_measured_only_where_a_sog_is_requested(scene: SmallScene, tmp_path: Path) -> None:
    _, metrics = decide(scene, tmp_path, formats=())
    assert metrics["bits"] is None


@pytest.mark.parametrize("more", [("sog",), ("sog", "splat", "spz")])
def test_a_further_format_measures_only_what_it_needs_and_gives_the_same_bytes(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: tuple[str, ...]
) -> None:
    inputs = {
        "sfm": scene.reconstruction,
        "train": TrainedSplats(scene.splats.with_antialias(True)),
        "prune": PrunedSplats(scene.splats.with_antialias(True)),
    }

    def run(folder: str, formats: tuple[str, ...], earlier: Earlier | None = None) -> Report:
        report = Report(earlier=earlier)
        settings = QuantiseSettings(formats=formats, plain_steps=2, rounding_steps=1)
        (tmp_path / folder).mkdir()
        quantise.run(inputs, settings, tmp_path / folder, report)
        return report

    first, whole = run("first", ("ply", "splat")), run("whole", ("ply", *more))
    earlier = Earlier(tmp_path / "first", {}, first.metrics, (), frozenset(inputs))
    for name in ("_choose_sh_degrees", "_figures", "_flat_colours"):
        monkeypatch.setattr(quantise, name, lambda *_: 1 / 0)
    added = run("added", ("ply", *more), earlier)
    assert added.metrics == whole.metrics
    found = [
        {path.relative_to(tmp_path / folder): path.read_bytes() for path in paths}
        for folder in ("whole", "added")
        for paths in [(tmp_path / folder).rglob("*.*")]
    ]
    assert found[0] == found[1]


def test_a_further_format_that_is_drawn_in_another_way_takes_the_sh_degrees_alone(
    scene: SmallScene, tmp_path: Path
) -> None:
    inputs = {
        "sfm": scene.reconstruction,
        "train": TrainedSplats(scene.splats.with_antialias(True)),
        "prune": PrunedSplats(scene.splats.with_antialias(True)),
    }
    reports: dict[str, Report] = {}
    for folder, formats in (("first", ("spz",)), ("whole", ("spz", "splat")), ("added", None)):
        first = reports.get("first")
        earlier = None
        if formats is None and first is not None:
            earlier = Earlier(tmp_path / "first", {}, first.metrics, (), frozenset(inputs))
        settings = QuantiseSettings(
            formats=formats or ("spz", "splat"), plain_steps=2, rounding_steps=1
        )
        reports[folder] = Report(earlier=earlier)
        (tmp_path / folder).mkdir()
        quantise.run(inputs, settings, tmp_path / folder, reports[folder])
    assert reports["added"].metrics == reports["whole"].metrics
    for path in (tmp_path / "whole").rglob("*.*"):
        same = tmp_path / "added" / path.relative_to(tmp_path / "whole")
        assert same.read_bytes() == path.read_bytes()
