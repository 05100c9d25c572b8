"""Training as a whole: known small problems, and runs that stop and go on."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from splatcli.run_result import headline
from stages.base.errors import Interrupted, SplatError
from stages.base.stage import Report
from stages.evaluate.evaluation import EvaluationView, evaluate
from stages.evaluate.image_metrics import psnr
from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.draw import render
from stages.raster.smoothing import smoothing_widths
from stages.scene import DrawSettings, Splats, TrainedSplats, look_at, split_held_out
from stages.train import cap
from stages.train import stage as train
from stages.train.checkpoint import MAGIC
from stages.train.clock import Clock, Elapsed
from stages.train.conversion import splats_of
from stages.train.density import AdaptiveDensity, cull
from stages.train.hooks import EVALUATIONS
from stages.train.loop import train as train_all
from stages.train.loss import image_loss
from stages.train.optimiser import LearningRates, apply_gradients, new_model
from stages.train.schedule import SCALES, Schedule
from stages.train.settings import TrainSettings
from stages.train.views import Level, TrainingView, load_views
from tests.scenes import camera, cloud, splats
from tests.small_scene import small_scene
from tests.train.pictures import trainer_of, view_of


def trainer(views, start, steps, folder, report=None, degree=0, cap=10_000, backend="cpu"):
    schedule = Schedule(steps=steps, extent=10.0, sh_degree=degree, n_start=len(start), seed=0)
    held_out = [
        EvaluationView(view.name, view.levels[-1].camera, view.levels[-1].pixels.transpose(1, 2, 0))
        for view in views
    ]
    report = report or Report()
    return trainer_of(
        schedule, views, held_out, DrawSettings(near=0.1), cap, folder, report, backend=backend
    )


def psnr_of(trained):
    """Of the first photograph, drawn as it is now."""
    return evaluate(trained.render, trained.task.held_out)[0].psnr_db


def disc_and_square():
    ys, xs = np.mgrid[:48, :48] + 0.5
    picture = np.ones((48, 48, 3), np.float32)
    picture[(xs - 16) ** 2 + (ys - 18) ** 2 < 81] = (1, 0, 0)
    picture[(abs(xs - 32) < 8) & (abs(ys - 32) < 8)] = (0, 0, 1)
    return picture


def grid(side):
    at = (np.arange(side) + 0.5) / side * 0.8 - 0.4
    xs, ys = np.meshgrid(at, at)
    means = np.stack([xs.ravel(), ys.ravel(), np.ones(side * side)], 1)
    return splats(means, scales=0.4 / side, opacities=0.5, rgb=(0.6, 0.6, 0.6))


TOY_RATES = LearningRates(3e-3, 1e-2, 2e-2, 5e-2, 3e-2)


def fit(pictures, scene, steps, rates, degree=0):
    """Renders of `scene` once fitted to [(picture [H, W, 3], camera)], by L1 alone."""
    rasteriser, settings = CpuRasteriser(), RasterSettings(sh_degree=degree)
    model = new_model(*splat_arrays(scene.with_sh_degree(degree)))
    targets = [np.ascontiguousarray(p.transpose(2, 0, 1), np.float32) for p, _ in pictures]
    v_image = np.empty_like(targets[0])
    for step in range(steps):
        target, (_, where) = (both[step % len(pictures)] for both in (targets, pictures))
        forward = rasteriser.forward(model.arrays, where, settings)
        image_loss(rasteriser.pool, forward.image, target, v_image, ssim_weight=0.0)
        backward = rasteriser.backward(forward, v_image)
        shrink = 0.1 ** (step / steps)
        now = rates.scaled(rates.means * shrink, shrink)
        coefficients = (degree + 1) ** 2
        apply_gradients(
            rasteriser.pool, model, backward, coefficients, now, where.width, where.height
        )
    renders = []
    for _, where in pictures:
        image = rasteriser.forward(model.arrays, where, settings).image[:3]
        renders.append(np.clip(image.transpose(1, 2, 0), 0, 1))
    return renders


@pytest.mark.slow
def test_more_splats_fit_a_disc_and_a_square_better():
    """Mean squared error about 0.02 with 16 splats, low 1e-3 with 64, 0.001 to 0.002 with 256."""
    picture = disc_and_square()
    errors = []
    for side in (4, 8, 16):
        (image,) = fit([(picture, camera(48, 48))], grid(side), 800, TOY_RATES)
        errors.append(float(np.mean((image - picture) ** 2)))
    assert errors == sorted(errors, reverse=True)
    assert 0.006 < errors[0] < 0.04
    assert errors[1] < 0.006
    assert errors[2] < 0.002


def test_view_dependence_needs_more_than_a_constant_colour():
    """Two greys 0.08 apart, seen from the front and the back: one constant colour can at best be
    their mean, which is 28 dB from both. Degree 3 can be each of them."""
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind[2, 3] = 2.0
    pictures = [
        (np.full((48, 48, 3), 0.46, np.float32), camera(48, 48)),
        (np.full((48, 48, 3), 0.54, np.float32), camera(48, 48, matrix=behind)),
    ]
    # splats that move could hide one layer behind another
    colours_only = LearningRates(0.0, 0.0, 0.0, 0.0, 3e-2, 3e-2)
    worst = {}
    for degree in (0, 3):
        renders = fit(pictures, grid(8), 600, colours_only, degree)
        worst[degree] = min(
            psnr(image[8:40, 8:40], picture[8:40, 8:40])
            for image, (picture, _) in zip(renders, pictures, strict=True)
        )
    assert 26 < worst[0] < 28
    assert worst[3] > 35


def small_problem(tmp_path, name, report=None, steps=60, backend="cpu"):
    truth = cloud(80, 40, 30, degree=1)
    where = camera(40, 30)
    picture = np.clip(render(truth, where, RasterSettings()).image, 0, 1)
    start = cloud(60, 40, 30, degree=0, seed=4)
    folder = tmp_path / name
    folder.mkdir(exist_ok=True)
    views = [view_of("a", picture, where)]
    return trainer(views, start, steps, folder, report, degree=1, backend=backend), start


def test_training_brings_the_picture_closer(tmp_path):
    t, start = small_problem(tmp_path, "a", steps=200)
    t.begin(start)
    before = psnr_of(t)
    train_all(t, start)
    assert psnr_of(t) > before + 5


@pytest.mark.parametrize("stop_at", [1, 17, 43, 57])  # the last while parameters are averaged
def test_a_stopped_run_goes_on_to_the_same_bytes(tmp_path, stop_at):
    whole, start = small_problem(tmp_path, "whole")
    wanted = train_all(whole, start)
    report = Report()

    def stop(label, done, total, numbers):
        if done == stop_at:
            report.stop_requested.set()

    report.listener = stop
    first, start = small_problem(tmp_path, "parts", report)
    with pytest.raises(Interrupted):
        train_all(first, start)
    second, start = small_problem(tmp_path, "parts")
    found = train_all(second, start)
    assert second.task.report.metrics["resumed_from_step"] >= stop_at
    for a, b in zip(vars(found).values(), vars(wanted).values(), strict=True):
        assert a.tobytes() == b.tobytes()
    assert second.history.entries == whole.history.entries


def test_a_time_limit_takes_as_many_steps_as_fit_and_not_many_more(tmp_path, monkeypatch):
    """By a clock of its own, on which each step takes 10 ms."""

    class StepClock:
        def __init__(self, before=None):
            self.steps = 0

        def elapsed(self):
            return Elapsed(0.01 * self.steps)

    monkeypatch.setattr("stages.train.trainer.Clock", StepClock)
    timed, start = small_problem(tmp_path, "limited", steps=60)
    timed.task = replace(timed.task, seconds=1.2)
    step = timed.step

    def counted(number):
        timed.clock.steps += 1
        return step(number)

    timed.step = counted
    train_all(timed, start)
    assert timed.schedule.steps == pytest.approx(120, abs=6)
    assert timed.clock.steps == timed.schedule.steps
    assert timed.schedule.share(timed.schedule.steps) == pytest.approx(1.0)


def test_time_goes_on_over_an_interruption_and_each_entry_of_the_history_has_its_own(tmp_path):
    report = Report()
    t, start = small_problem(tmp_path, "parts", report, steps=40)

    def stop(label, done, total, numbers):
        if done == 20:
            t.clock = Clock(Elapsed(100.0, 300.0))  # as if it had taken so long
            report.stop_requested.set()

    report.listener = stop
    with pytest.raises(Interrupted):
        train_all(t, start)
    second, start = small_problem(tmp_path, "parts", steps=40)
    train_all(second, start)
    seconds = [elapsed.seconds for elapsed in second.history.times]
    assert len(second.history.times) == len(second.history.entries) == EVALUATIONS
    assert seconds == sorted(seconds)
    assert 0 < seconds[4] < 100 < seconds[5]
    assert second.history.times[-1].cpu_seconds > 300


def test_a_live_preview_does_not_change_what_is_trained(tmp_path):
    """Every step drawn, from elsewhere, larger and smaller than the photographs; the model grows on
    the way."""
    alone, start = small_problem(tmp_path, "alone", steps=150)
    wanted = train_all(alone, start)
    drawn: list[np.ndarray] = []
    report = Report()

    def keep(draw):
        width, height = (97, 61) if len(drawn) % 2 else (19, 23)
        where = camera(width, height, matrix=look_at(np.array([2.0, -1, -3]), np.zeros(3)))
        drawn.append(draw(where))
        assert drawn[-1].shape == (height, width, 3)

    report.preview = keep
    watched, start = small_problem(tmp_path, "watched", report, steps=150)
    found = train_all(watched, start)
    assert len(drawn) == 150
    assert len(found) > len(start)
    for a, b in zip(vars(found).values(), vars(wanted).values(), strict=True):
        assert a.tobytes() == b.tobytes()
    assert watched.history.entries == alone.history.entries


def test_the_live_preview_is_what_the_reference_draws(tmp_path):
    report = Report()
    t, start = small_problem(tmp_path, "seen", report, steps=40)
    where = camera(48, 36)
    seen = []
    report.preview = lambda draw: seen.append(draw(where))
    trained = splats_of(train_all(t, start), 1, start, t.task.draw_settings)
    settings = t.raster_settings(t.schedule.sh_degree)
    image = render(trained, where, settings, backend="reference").image
    levels = np.rint(np.clip(image, 0, 1) * 255)
    assert np.abs(seen[-1] - levels).max() <= 1  # rounding of halves
    assert np.abs(seen[0] - levels).mean() > 5  # the first step looked different


def test_a_torn_checkpoint_means_a_fresh_start_and_a_warning(tmp_path):
    report = Report()
    t, start = small_problem(tmp_path, "torn", report)
    (t.task.folder / "checkpoint.bin").write_bytes(MAGIC + b"\x00" * 5)
    wanted, start2 = small_problem(tmp_path, "whole")
    assert train_all(t, start).means.tobytes() == train_all(wanted, start2).means.tobytes()
    assert "train-checkpoint-damaged" in dict(report.warnings)


def test_a_run_with_a_damaged_checkpoint_goes_on_from_the_one_before(tmp_path, monkeypatch):
    monkeypatch.setattr("stages.train.hooks.CHECKPOINT_SECONDS", 0.0)
    whole, start = small_problem(tmp_path, "whole", steps=30)
    wanted = train_all(whole, start)
    stopping, report = Report(), Report()
    stopping.listener = lambda label, done, total, numbers: (
        stopping.stop_requested.set() if done == 20 else None
    )
    first, start = small_problem(tmp_path, "parts", stopping, steps=30)
    with pytest.raises(Interrupted):
        train_all(first, start)
    path = first.task.folder / "checkpoint.bin"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    second, start = small_problem(tmp_path, "parts", report, steps=30)
    found = train_all(second, start)
    assert 0 < report.metrics["resumed_from_step"] <= 20
    assert "train-checkpoint-damaged" in dict(report.warnings)
    for a, b in zip(vars(found).values(), vars(wanted).values(), strict=True):
        assert a.tobytes() == b.tobytes()


def test_the_reference_backend_trains_to_the_same_place(tmp_path):
    fast, start = small_problem(tmp_path, "fast", steps=10)
    slow, _ = small_problem(tmp_path, "slow", steps=10, backend="reference")
    a, b = train_all(fast, start), train_all(slow, start)
    assert len(a) == len(b)
    # Adam divides a gradient by its own size: where that is rounding noise, steps may differ
    assert np.median(np.abs(a.means - b.means)) < 1e-6
    assert np.median(np.abs(a.sh - b.sh)) < 1e-6


def test_invalid_rows_at_the_start_do_not_spread(tmp_path):
    t, start = small_problem(tmp_path, "bad")
    means = start.means.copy()
    means[3] = np.nan
    broken = Splats(
        means,
        start.quaternions,
        start.log_scales,
        start.opacity_logits,
        start.sh,
        start.sh_degrees,
    )
    model = train_all(t, broken)
    for array in model.arrays:
        assert np.isfinite(array).all()
    clean, start = small_problem(tmp_path, "clean")
    train_all(clean, start)
    assert psnr_of(t) == pytest.approx(psnr_of(clean), abs=1.0)  # of 60 splats one is missing


def test_a_run_that_loses_every_splat_ends(tmp_path):
    t, start = small_problem(tmp_path, "none", steps=120)
    faint = np.full(len(start), -12.0, np.float32)
    model = train_all(t, replace(start, opacity_logits=faint))
    assert len(model) == 0
    assert len(splats_of(model, 1, start, t.task.draw_settings)) == 0
    assert t.history.entries[-1].splats == 0


def test_the_stage_says_so_when_nothing_is_left(tmp_path, monkeypatch):
    t, start = small_problem(tmp_path, "none", steps=120)
    monkeypatch.setattr(train, "make_trainer", lambda *_: t)
    faint = replace(start, opacity_logits=np.full(len(start), -12.0, np.float32))
    with pytest.raises(SplatError) as error:
        train.run({"sfm": None, "seed": faint}, TrainSettings(), t.task.folder, Report())
    assert error.value.code == "train-nothing-left"


def test_nothing_at_all_can_be_taken_grown_and_culled():
    empty = new_model(*splat_arrays(grid(2).take(np.zeros(4, bool))))
    strategy = AdaptiveDensity(views=8)
    assert len(strategy.grow(empty, 100)) == 0
    assert len(cull(empty)) == 0
    assert len(empty.take(np.zeros(0, bool))) == 0


def test_under_the_smoothing_filter_no_trained_splat_is_finer_than_its_photographs(tmp_path):
    scene = small_scene(tmp_path)
    start = scene.splats.with_sh_degree(0)
    settings = TrainSettings(steps=60, train_side=72, sh_degree=0, max_splats=400, smooth=True)
    folder = tmp_path / "train"
    folder.mkdir()
    report = Report()
    found = train.run({"sfm": scene.reconstruction, "seed": start}, settings, folder, report).splats
    kept, _ = split_held_out(scene.reconstruction.views)
    widths = smoothing_widths(found.means, [v.camera.fitted(72) for v in kept], near=0.01)
    assert (np.exp(found.log_scales).min(1) >= 0.999 * widths).all()
    assert report.metrics["psnr_db"] > 20
    _shown_at_every_size(report, folder)


def _shown_at_every_size(report, folder):
    """The manifest and the contact sheet's legend give the half and quarter size."""
    figures = [report.metrics[n] for n in ("psnr_db", "psnr_half_db", "psnr_quarter_db")]
    for number, view in enumerate(report.metrics["held_out"]):
        shown = (folder / "held_out.txt").read_text().splitlines()[number]
        assert f"quarter size {view['psnr_quarter_db']:.2f} dB" in shown
    halves = [view["psnr_half_db"] for view in report.metrics["held_out"]]
    assert figures[1] == pytest.approx(np.mean(halves), abs=1e-3)


class KilledError(Exception):
    pass


@pytest.mark.parametrize("how", ["killed before its first checkpoint", "stopped at a checkpoint"])
def test_a_run_goes_on_under_its_first_cap_whatever_memory_is_free_by_then(
    tmp_path, monkeypatch, how
):
    scene = small_scene(tmp_path)
    inputs = {"sfm": scene.reconstruction, "seed": scene.splats.with_sh_degree(0)}
    settings = TrainSettings(steps=30, train_side=48, sh_degree=0, max_splats=0)
    monkeypatch.setattr(cap, "splat_cap", int)

    def trained(name, free_mib, stopping=False):
        monkeypatch.setattr(cap, "available_mib", lambda: free_mib)
        folder, report = tmp_path / name, Report()
        folder.mkdir(exist_ok=True)

        def stop(label, done, total, numbers):
            if stopping and label == "training" and done == 12:
                report.stop_requested.set()
                if "killed" in how:
                    raise KilledError

        report.listener = stop
        train.run(inputs, settings, folder, report)
        return (folder / "splats.bin").read_bytes(), report.metrics, dict(report.warnings)

    few, figures, warnings = trained("few", 100.0)
    many, *_ = trained("many", 400.0)
    assert few != many
    assert (figures["splat_cap"], figures["splat_cap_from"]) == (100, "free memory")
    assert figures["splat_cap_free_mib"] == 100
    assert warnings["train-splat-cap-reached"] == (
        "Free memory (104.9 MB) limited training to 100 splats; 100,000 more take 160.0 MB."
    )
    with pytest.raises((KilledError, Interrupted)):
        trained("broken", 100.0, stopping=True)
    assert (tmp_path / "broken" / "checkpoint.bin").exists() == ("stopped" in how)
    again, *_ = trained("broken", 400.0)
    assert again == few
    assert not (tmp_path / "broken" / "cap.json").exists()


def test_a_run_that_another_backend_goes_on_with_says_so(tmp_path):
    scene = small_scene(tmp_path, views=4, n=40)
    inputs = {"sfm": scene.reconstruction, "seed": scene.splats.with_sh_degree(0)}
    folder, labels = tmp_path / "train", []
    folder.mkdir()

    def trained(backend, stop_at=None):
        report = Report()

        def listen(label, done, total, numbers):
            labels.append(label)
            if label == "training" and done == stop_at:
                report.stop_requested.set()

        report.listener = listen
        settings = TrainSettings(6, train_side=24, sh_degree=0, max_splats=60, backend=backend)
        train.run(inputs, settings, folder, report)
        return report

    with pytest.raises(Interrupted):
        trained("cpu", stop_at=2)
    assert not any("resuming with" in label for label in labels)
    report = trained("reference")
    assert "resuming with reference what cpu began" in labels
    assert [(entry["step"], entry["backend"]) for entry in report.metrics["provenance"]] == [
        (0, "cpu"),
        (3, "reference"),
    ]
    assert report.metrics["trained_by"] == "cpu (cpu) to step 3, then reference (cpu)"
    assert "then reference" in dict(report.warnings)["train-several-backends"]
    line = headline(cast(Any, SimpleNamespace(stage="train", metrics=report.metrics)))
    assert f"steps 6, side 24 px, splats {report.metrics['splats']}" in line
    assert "trained by cpu (cpu) to step 3" in line
    assert "train-several-backends" not in dict(trained("cpu").warnings)


def test_a_cap_that_the_user_or_a_preset_set_is_reported_without_a_warning(tmp_path):
    scene = small_scene(tmp_path)
    inputs = {"sfm": scene.reconstruction, "seed": scene.splats.with_sh_degree(0)}
    settings = TrainSettings(steps=30, train_side=48, sh_degree=0, max_splats=100)
    report = Report()
    (tmp_path / "out").mkdir()
    train.run(inputs, settings, tmp_path / "out", report)
    assert report.metrics["densified_splats"] == report.metrics["splat_cap"] == 100
    assert "train-splat-cap-reached" not in dict(report.warnings)
    assert cap.cap_for(tmp_path, 500, 100) == cap.Cap(500, "--max-splats")
    assert not (tmp_path / cap.FILE_NAME).exists()


def test_trained_splats_know_their_steps_and_those_of_an_older_version_do_not(tmp_path):
    scene = small_scene(tmp_path)
    folder = tmp_path / "out"
    folder.mkdir()
    train.save(folder, TrainedSplats(scene.splats, dropout=True, steps=30))
    assert (train.load(folder).steps, train.load(folder).dropout) == (30, True)
    facts = json.loads((folder / "training.json").read_text())
    del facts["steps"]
    (folder / "training.json").write_text(json.dumps(facts))
    assert train.load(folder).steps == 0


@pytest.mark.parametrize("seconds", [0.0, 0.5])
def test_a_time_limit_that_left_few_steps_is_a_warning(tmp_path, monkeypatch, seconds):
    monkeypatch.setattr(train, "_FEW_STEPS", 10**6)  # however fast the machine is
    scene = small_scene(tmp_path)
    inputs = {"sfm": scene.reconstruction, "seed": scene.splats.with_sh_degree(0)}
    settings = TrainSettings(steps=30, train_side=48, sh_degree=0, max_splats=100, seconds=seconds)
    report = Report()
    (tmp_path / "out").mkdir()
    train.run(inputs, settings, tmp_path / "out", report)
    warned = dict(report.warnings).get("train-few-steps", "")
    steps = report.metrics["steps"]
    assert warned.startswith(f"The time limit left {steps:,} steps") if seconds else not warned


def test_splats_have_no_more_parameters_than_the_views_have_values(tmp_path, monkeypatch):
    """60 x 40 pixels of three numbers each; a splat of degree 1 has 23, one of degree 3 has 59."""
    small = camera(width=60, height=40)
    monkeypatch.setattr(cap, "MIN_CAP", 10)
    assert cap.splats_determined([small] * 5, 1) == 5 * 60 * 40 * 3 // 23
    assert cap.splats_determined([small] * 5, 3) == 5 * 60 * 40 * 3 // 59
    monkeypatch.setattr(cap, "available_mib", lambda: 4096.0)
    assert cap.cap_for(tmp_path, 0, 610) == cap.Cap(610, cap.PHOTOGRAPHS)
    assert cap.cap_for(tmp_path, 0, 10**9).splats == 610  # it stays as it began
    (tmp_path / cap.FILE_NAME).unlink()
    assert cap.cap_for(tmp_path, 0, 10**9).origin == "free memory"


def test_few_views_allow_fewer_splats_and_no_number_of_views_more(tmp_path, monkeypatch):
    assert cap.cap_for(tmp_path, 250_000, 10**9, 140_000) == cap.Cap(140_000, cap.VIEWS)
    assert cap.cap_for(tmp_path, 250_000, 10**9, 700_000) == cap.Cap(250_000, "--max-splats")
    monkeypatch.setattr(cap, "available_mib", lambda: 4096.0)
    assert cap.cap_for(tmp_path, 0, 10**9, 20_000) == cap.Cap(20_000, cap.VIEWS)
    assert cap.cap_for(tmp_path, 0, 10**9, 30_000).splats == 20_000  # it stays as it began
    (tmp_path / cap.FILE_NAME).unlink()
    assert cap.cap_for(tmp_path, 0, 15_000, 20_000) == cap.Cap(15_000, cap.PHOTOGRAPHS)


def test_a_limit_for_each_view_is_that_times_the_training_views(tmp_path):
    scene = small_scene(tmp_path)
    inputs = {"sfm": scene.reconstruction, "seed": scene.splats.with_sh_degree(0)}
    settings = TrainSettings(
        steps=30, train_side=48, sh_degree=0, max_splats=10_000, splats_per_view=20
    )
    report = Report()
    (tmp_path / "out").mkdir()
    train.run(inputs, settings, tmp_path / "out", report)
    assert report.metrics["splat_cap"] == 20 * report.metrics["training_views"]
    assert report.metrics["splat_cap_from"] == "--splats-per-view"


def test_a_damaged_cap_file_is_written_again(tmp_path, monkeypatch):
    monkeypatch.setattr(cap, "available_mib", lambda: 4096.0)
    for text in ("", "[]", '{"splats": "many", "origin": "?"}', '{"splats": 0, "origin": "?"}'):
        (tmp_path / cap.FILE_NAME).write_text(text)
        assert cap.cap_for(tmp_path, 0, 10**9).free_mib == 4096
        assert cap.cap_for(tmp_path, 0, 10**9) == cap._read(tmp_path / cap.FILE_NAME)


def test_pictures_on_disk_train_to_the_same_bytes_as_pictures_in_memory(tmp_path):
    scene = small_scene(tmp_path)
    folder, views = scene.reconstruction.folder, scene.reconstruction.views
    stored = load_views(folder, views, 48, tmp_path / "work")
    held = [
        TrainingView(
            view.name,
            tuple(
                Level(one.camera, one.pixels.copy(), one.means)
                for one in map(view.levels.__getitem__, range(len(SCALES)))
            ),
        )
        for view in stored
    ]
    models = []
    for name, chosen in (("a", stored), ("b", held)):
        (tmp_path / name).mkdir()
        models.append(train_all(trainer(chosen, scene.splats, 12, tmp_path / name), scene.splats))
    for one, other in zip(models[0].arrays, models[1].arrays, strict=True):
        assert one.tobytes() == other.tobytes()
