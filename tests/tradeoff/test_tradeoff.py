"""The report of a small scene, and two runs side by side."""

from __future__ import annotations

import csv
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.evaluate.evaluation import load_evaluation_views
from stages.formats import FORMATS
from stages.prune.settings import PruneSettings
from stages.prune.stage import pruner_of
from stages.scene import (
    IGNORE,
    TRANSPARENT,
    DrawSettings,
    QuantisedSplats,
    TrainedSplats,
    evenly_spaced,
    split_held_out,
)
from stages.tradeoff import report_text
from stages.tradeoff.comparison import (
    Candidate,
    compare_runs,
    fact_rows,
    verdict_lines,
    write_comparison,
)
from stages.tradeoff.intervals import BETTER, INCONCLUSIVE, TRAINING_VIEWS, WORSE
from stages.tradeoff.measurement import SHARES, TradeoffInputs, measure_tradeoff
from stages.tradeoff.report import write_report
from tests.small_scene import small_scene

COURSE = [
    {"step": s, "splats": s, "psnr_db": db, "seconds": s / 10, "cpu_seconds": s / 5}
    for s, db in ((100, 20.0), (200, 24.0), (300, 24.5), (400, 24.6))
]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return small_scene(tmp_path_factory.mktemp("photographs"))


@pytest.fixture(scope="module")
def inputs(scene):
    draw_settings = DrawSettings(near=0.01, side=72)
    reconstruction = scene.reconstruction
    training, held = (
        load_evaluation_views(reconstruction.folder, views, draw_settings)
        for views in split_held_out(reconstruction.views)
    )
    splats = replace(scene.splats, draw_settings=draw_settings)
    trained = TrainedSplats(splats)

    def prune_to(some, count):
        asked = PruneSettings(max_splats=count)
        return (
            pruner_of(asked, reconstruction, trained, training, "cpu", Report()).prune(some).splats
        )

    return TradeoffInputs(
        splats,
        held,
        evenly_spaced(training, TRAINING_VIEWS),
        reconstruction.views,
        "metres",
        "cpu",
        COURSE,
        ("ply", "spz"),
        prune_to=prune_to,
    )


@pytest.fixture(scope="module")
def tradeoff(inputs):
    return measure_tradeoff(inputs, lambda label: None)


@pytest.mark.slow
def test_every_format_is_written_and_evaluated(tradeoff) -> None:
    points = {point.label.removeprefix("."): point for point in tradeoff.formats}
    assert points.keys() == FORMATS.keys()
    assert points["ply"].change.mean == 0
    assert points["splat"].change.mean < -0.05  # no colour that depends on the view
    assert points["spz"].size_bytes < points["ply"].size_bytes / 3
    sizes = [point.size_bytes for point in tradeoff.formats]
    assert sizes == sorted(sizes)


@pytest.mark.slow
def test_formats_are_written_with_the_precision_that_the_run_chose(inputs, tmp_path) -> None:
    bits = {"position": 11, "rotation": 4, "scale": 4, "colour": 4, "opacity": 4, "palette": 5}
    decided = QuantisedSplats(inputs.splats, bits)
    found = [
        next(p for p in measure_tradeoff(m, lambda label: None).formats if p.label == ".sog")
        for m in (inputs, replace(inputs, quantised=decided))
    ]
    assert (found[1].size_bytes or 0) < 0.9 * (found[0].size_bytes or 0)
    assert found[1].change.mean < found[0].change.mean


def test_held_out_views_do_not_decide_which_splats_are_removed(tradeoff, inputs) -> None:
    assert [point.splats for point in tradeoff.pruned] == [250, *(round(250 * s) for s in SHARES)]
    losses = [point.psnr_db for point in tradeoff.pruned]
    assert losses[0] - losses[1] < 1.0 < losses[0] - losses[-1]
    noise = np.random.default_rng(0)
    noisy = [
        replace(p, pixels=noise.integers(0, 256, p.pixels.shape, np.uint8)) for p in inputs.held_out
    ]
    other = measure_tradeoff(replace(inputs, held_out=noisy), lambda label: None)
    assert [p.splats for p in other.pruned] == [p.splats for p in tradeoff.pruned]
    assert other.own.psnr_db < 12


def test_pruning_by_contribution_is_better_than_by_chance(tradeoff, inputs) -> None:
    from stages.evaluate.evaluation import mean_psnr_db

    half = next(point for point in tradeoff.pruned if point.splats == 125)
    chance = inputs.splats.take(np.random.default_rng(1).permutation(250)[:125])
    assert half.psnr_db > mean_psnr_db(chance, inputs.held_out, "cpu") + 1


def test_pruning_costs_what_the_report_foretold(tradeoff, inputs) -> None:
    """The first number is reached as `splat prune` reaches it, others by way of larger ones: to a
    twentieth of the loss."""
    from stages.evaluate.evaluation import mean_psnr_db

    counts = [round(250 * s) for s in SHARES]
    for place, share in ((0, 1e-9), (3, 0.05)):
        pruned = inputs.prune_to(inputs.splats, counts[place])
        loss_db = tradeoff.own.psnr_db - mean_psnr_db(pruned, inputs.held_out, "cpu")
        foretold_db = tradeoff.own.psnr_db - tradeoff.pruned[1 + place].psnr_db
        assert foretold_db == pytest.approx(loss_db, abs=share * loss_db)


def test_pruning_starts_from_what_was_trained(inputs) -> None:
    seen = []

    def keeping(splats, count):
        seen.append((len(splats), count))
        return splats.take(np.arange(count))

    fewer = replace(inputs, splats=inputs.splats.take(np.arange(200)), trained=inputs.splats)
    measure_tradeoff(replace(fewer, prune_to=keeping), lambda label: None)
    counts = [round(200 * s) for s in SHARES]
    assert seen == list(zip([250, *counts], counts, strict=False))


def test_the_report_is_one_file_that_needs_no_other(tradeoff, inputs, tmp_path) -> None:
    files = write_report(tmp_path, "<scene>", tradeoff, inputs)
    assert {file.name for file in files} == {
        *("report.html", "tradeoff.csv"),
        *(f"{n}.png" for n in ("time", "splats")),
    }
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert not re.findall(r"(?:src|href)=\"(?!data:)", text)
    assert "<script" not in text
    assert "Trade-off report: &lt;scene&gt;" in text
    assert report_text.FINE_TUNED in text
    assert tradeoff.worst.name in text
    assert "<h2>Coverage</h2>" in text


def test_the_table_holds_every_point(tradeoff, inputs, tmp_path) -> None:
    write_report(tmp_path, "scene", tradeoff, inputs)
    with (tmp_path / "tradeoff.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    counts = {curve: sum(row["curve"] == curve for row in rows) for curve in ("time", "format")}
    assert counts == {"time": len(COURSE), "format": len(FORMATS)}
    assert all(row["psnr_db"] for row in rows)
    last = [row for row in rows if row["curve"] == "time"][-1]
    assert (last["splats"], last["wall_seconds"], last["psnr_db"]) == ("400", "40.00", "24.6000")


def test_plots_have_axes_with_units_and_legends(tradeoff, inputs, tmp_path, monkeypatch) -> None:
    from stages.tradeoff import plots

    shown = {}
    monkeypatch.setattr(plots, "write_plot", lambda path, figure: shown.update({path.stem: figure}))
    plots.write_plots(tmp_path, tradeoff)
    labels = {name: figure.axes[0].get_xlabel() for name, figure in shown.items()}
    assert labels == {"time": "CPU time of all threads (s)", "splats": "splats"}
    for figure in shown.values():
        assert figure.axes[0].get_ylabel() == "held-out PSNR (dB)"
        assert figure.axes[0].get_legend() is not None


@pytest.mark.slow
def test_a_run_without_a_log_gets_the_other_curves(inputs, tmp_path) -> None:
    tradeoff = measure_tradeoff(replace(inputs, history=()), lambda label: None)
    files = write_report(tmp_path, "scene", tradeoff, inputs)
    assert "time.png" not in {file.name for file in files}
    assert report_text.NO_COURSE in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_single_held_out_view_has_an_interval(scene, inputs, tmp_path) -> None:
    tradeoff = measure_tradeoff(replace(inputs, held_out=inputs.held_out[:1]), lambda label: None)
    write_report(tmp_path, "scene", tradeoff, inputs)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "With 1 held-out view, intervals are wide." in text
    assert "inf" not in re.sub(r"<[^>]*>", " ", text)
    assert tradeoff.pruned[-1].change.verdict == WORSE
    few = replace(scene.reconstruction, views=scene.reconstruction.views[:5])
    both = [replace(side(scene, name), reconstruction=few) for name in "ab"]
    lines = verdict_lines(compare_runs(*both))
    assert (
        lines[0]
        == "b against a: +0.00 dB (other views, 90 %: +0.00 to +0.00): no significant difference."
    )
    assert "1 held-out view," in lines[-1]


def side(scene, name: str, splats=None) -> Candidate:
    draw_settings = DrawSettings(near=0.01, side=72)
    return Candidate(
        name,
        replace(splats or scene.splats, draw_settings=draw_settings),
        scene.reconstruction,
        "cpu",
        {},
    )


def test_a_run_does_not_differ_from_itself(scene) -> None:
    found = compare_runs(side(scene, "a"), side(scene, "b"))
    assert (found.psnr.mean, found.psnr.verdict) == (0, INCONCLUSIVE)
    assert (
        "b against a: +0.00 dB (other views, 90 %: +0.00 to +0.00): no significant difference."
        in verdict_lines(found)
    )


def test_a_worse_run_is_worse_and_the_other_way_round_better(scene) -> None:
    fewer = side(scene, "fewer", scene.splats.take(slice(0, 120)))
    assert compare_runs(side(scene, "all"), fewer).psnr.verdict == WORSE
    assert compare_runs(fewer, side(scene, "all")).psnr.verdict == BETTER


def test_a_comparison_says_which_run_is_better_at_each_size(scene) -> None:
    fewer = side(scene, "fewer", scene.splats.take(slice(0, 120)))
    found = compare_runs(side(scene, "all"), fewer)
    assert [d.verdict for d in found.psnr_by_size.values()] == [WORSE] * 3
    (_, half, quarter, *_) = verdict_lines(found)
    assert half.startswith("At half size: -")
    assert quarter.startswith("At quarter size: -")
    assert [row[0] for row in fact_rows(found)][:3] == [
        f"held-out PSNR, {size} size" for size in ("full", "half", "quarter")
    ]


MIDDLE = np.zeros((54, 72), bool)
MIDDLE[10:44, 16:56] = True


def masked(
    scene, candidate: Candidate, name: str, mask: np.ndarray, outside: str = IGNORE
) -> Candidate:
    """A run whose views have `mask`, a file of this name; outside it they have what `outside`
    says."""
    reconstruction = scene.reconstruction
    Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(reconstruction.folder / name)
    views = (replace(view, mask=name, outside=outside) for view in reconstruction.views)
    return replace(candidate, reconstruction=replace(reconstruction, views=tuple(views)))


def test_a_run_is_not_better_for_ignoring_what_it_draws_wrong(scene) -> None:
    inside = (np.abs(scene.splats.means) < 0.35).all(1)
    sh = scene.splats.sh.copy()
    sh[inside] += np.float32(0.3)
    wrong = side(scene, "wrong", replace(scene.splats, sh=sh))
    brighter = replace(scene.splats, sh=scene.splats.sh + np.float32(0.02))
    first, second = side(scene, "first", brighter), masked(scene, wrong, "outer.png", ~MIDDLE)
    found = compare_runs(first, second)
    equal = compare_runs(masked(scene, first, "outer.png", ~MIDDLE), second)
    assert found.psnr == equal.psnr
    assert {size: d.mean for size, d in found.psnr_by_size.items()} == {
        size: d.mean for size, d in equal.psnr_by_size.items()
    }
    assert found.ssim == equal.ssim


def test_what_one_run_cuts_out_of_its_photographs_is_not_compared(scene) -> None:
    brighter = replace(scene.splats, sh=scene.splats.sh + np.float32(0.02))
    whole, same = side(scene, "whole"), side(scene, "same")
    cut_out = masked(scene, same, "middle.png", MIDDLE, TRANSPARENT)
    for pair in ((whole, cut_out), (cut_out, whole)):
        found = compare_runs(*pair)
        assert {change.mean for change in found.psnr_by_size.values()} == {0}
        assert found.ssim.mean == 0
    other = side(scene, "other", brighter)
    ignoring, cutting = (
        compare_runs(whole, masked(scene, other, "middle.png", MIDDLE, outside))
        for outside in (IGNORE, TRANSPARENT)
    )
    assert cutting.psnr == ignoring.psnr
    assert cutting.psnr.verdict == WORSE


def test_two_cut_outs_by_other_masks_are_compared_where_both_are_solid(scene) -> None:
    small = np.zeros_like(MIDDLE)
    small[16:38, 24:48] = True
    first, second = (
        masked(scene, side(scene, "a"), f"{name}.png", mask, TRANSPARENT)
        for name, mask in (("middle", MIDDLE), ("small", small))
    )
    found = compare_runs(first, second)
    assert (found.psnr.mean, found.ssim.mean) == (0, 0)
    for view in (*found.views[0], *found.views[1]):
        assert view.valid is not None
        np.testing.assert_array_equal(view.valid, small)


def test_what_two_cut_outs_draw_outside_their_equal_masks_counts(scene) -> None:
    fewer = side(scene, "fewer", scene.splats.take(np.abs(scene.splats.means).max(1) < 0.5))
    first, second = (
        masked(scene, one, "middle.png", MIDDLE, TRANSPARENT) for one in (side(scene, "all"), fewer)
    )
    found = compare_runs(first, second)
    assert all(view.valid is None for views in found.views for view in views)
    assert found.psnr.verdict == BETTER


def evened(scene, candidate: Candidate, light: bool) -> Candidate:
    """A run whose photographs differ in exposure, and whether it corrects that."""
    views = tuple(
        replace(view, light=(ev, ev, ev))
        for view, ev in zip(
            scene.reconstruction.views, np.resize([0.7, -0.7, 0.4], 10), strict=True
        )
    )
    settings = replace(candidate.splats.draw_settings, light=light)
    return replace(
        candidate,
        splats=replace(candidate.splats, draw_settings=settings),
        reconstruction=replace(scene.reconstruction, views=views),
    )


def test_runs_are_compared_in_one_light(scene) -> None:
    runs = [evened(scene, side(scene, f"light {on}"), on) for on in (True, False)]
    taken = evened(scene, side(scene, "taken"), False).views(["00.png"], 72, light=False)
    for pair in (runs, runs[::-1]):
        found = compare_runs(*pair)
        assert (found.psnr.mean, found.ssim.mean) == (0, 0)
        for views in found.views:
            np.testing.assert_array_equal(views[0].pixels, taken[0].pixels)
        assert any(line.startswith("Only light True was") for line in verdict_lines(found))
    both = compare_runs(runs[0], runs[0])
    assert (both.views[0][0].pixels != taken[0].pixels).any()
    assert not any("as they were taken" in line for line in verdict_lines(both))


def held_out_masked(scene, candidate: Candidate, names: list[str], mask: np.ndarray) -> Candidate:
    """A run in which views of these names ignore what is outside `mask`."""
    reconstruction = scene.reconstruction
    everywhere = masked(scene, candidate, "held_out.png", mask).reconstruction.views
    views = [
        one if one.name in names else view
        for one, view in zip(everywhere, reconstruction.views, strict=True)
    ]
    return replace(candidate, reconstruction=replace(reconstruction, views=tuple(views)))


@pytest.mark.parametrize("share", [0, 1 / 2])  # of the columns, every other one
def test_a_view_without_a_pixel_that_counts_is_not_compared(scene, share: float) -> None:
    names = [view.name for view in split_held_out(scene.reconstruction.views)[1]]
    assert len(names) == 2
    mask = np.zeros((54, 72), bool)
    mask[:, ::2] = share > 0
    fewer = side(scene, "fewer", scene.splats.take(slice(0, 120)))
    found = compare_runs(side(scene, "all"), held_out_masked(scene, fewer, names[:1], mask))
    assert found.psnr.views == 1
    assert [view.name for view in found.views[0]] == names[1:]
    assert [score.name for score in found.scores[1]] == names[1:]
    with pytest.raises(SplatError) as error:
        compare_runs(side(scene, "all"), held_out_masked(scene, fewer, names, mask))
    assert error.value.code == "compare-no-pixels"


def test_a_view_without_a_pixel_that_counts_is_in_no_operating_point(scene, inputs) -> None:
    few = replace(inputs, prune_to=None, held_out=list(inputs.held_out))
    nothing = np.zeros((54, 72), np.uint8)
    few.held_out[0] = replace(few.held_out[0], mask=nothing, outside=IGNORE)
    first, second = (
        measure_tradeoff(one, lambda label: None)
        for one in (few, replace(few, held_out=few.held_out[1:]))
    )
    assert first.own == second.own
    assert first.scores == second.scores


def test_both_are_compared_at_the_smaller_size(scene) -> None:
    small = side(scene, "small")
    small = replace(
        small, splats=replace(small.splats, draw_settings=DrawSettings(near=0.01, side=40))
    )
    found = compare_runs(side(scene, "large"), small)
    assert found.side_px == 40
    assert {max(p.pixels.shape[:2]) for seen in found.views for p in seen} == {40}


def test_a_training_view_of_one_run_is_not_compared(scene) -> None:
    views = scene.reconstruction.views[1:]
    shifted = replace(scene.reconstruction, views=views)
    with pytest.raises(SplatError) as error:
        compare_runs(side(scene, "a"), replace(side(scene, "b"), reconstruction=shifted))
    assert error.value.code == "compare-nothing-in-common"


def test_the_comparison_shows_every_held_out_view_three_times(scene, tmp_path) -> None:
    found = compare_runs(side(scene, "a"), side(scene, "b"))
    report, table = write_comparison(tmp_path, found)
    text = report.read_text(encoding="utf-8")
    assert text.count("<img") == 3 * found.psnr.views
    assert not re.findall(r"(?:src|href)=\"(?!data:)", text)
    assert len(table.read_text(encoding="utf-8").splitlines()) == 1 + found.psnr.views


def test_a_few_views_are_evenly_spaced() -> None:
    assert evenly_spaced(range(10), 5) == [0, 2, 4, 6, 8]
    assert evenly_spaced(range(3), 24) == [0, 1, 2]
