"""What is printed when a run is done."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from splatcli import console, run_result


@pytest.fixture(autouse=True)
def for_people(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever other commands of this process asked for."""
    monkeypatch.setattr(console.mode, "as_json", False)
    monkeypatch.setattr(console.mode, "quiet", False)


def shown(
    capsys: pytest.CaptureFixture[str],
    verdict: dict[str, str],
    settings: dict[str, Any] | None = None,
    views: int = 21,
    steps: int = 3150,
    run: str = "run",
    pruning: dict[str, Any] | None = None,
    until: str | None = "train",
) -> str:
    """The output for a run of `sfm` and `train` with `settings`, and of `prune` with the metrics
    `pruning`."""
    metrics: dict[str, Any] = {
        "sfm": {"unregistered_images": ["b.jpg"]},
        "train": {"verdict": verdict},
        **({} if pruning is None else {"prune": pruning}),
    }
    manifests = {
        name: SimpleNamespace(
            stage=name,
            seconds=2.0,
            cpu_seconds=2.0,
            peak_memory_mib=100.0,
            metrics=values,
            settings=settings or {},
            warnings=[],
        )
        for name, values in metrics.items()
    }
    metrics["train"] |= {"psnr_db": 27.107, "psnr_half_db": 27.494, "ssim": 0.8776}
    metrics["train"] |= {"training_views": views, "steps": steps, "side_px": 640}
    metrics["train"] |= {"splats": 113_229, "splat_cap": 147_000}
    metrics["train"] |= {"psnr_worst_db": 23.116, "psnr_worst_view": "IMG_0017.jpg"}
    pipeline: Any = SimpleNamespace(
        layout=SimpleNamespace(up_to=lambda until: [SimpleNamespace(name=n) for n in manifests]),
        manifest=manifests.get,
        stage_folder=lambda name: Path(run) / name,
        run_folder=Path(run),
    )
    run_result.show(pipeline, until)
    return capsys.readouterr().out


def test_the_last_lines_are_the_verdict_and_how_to_look_at_the_result(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = shown(capsys, {"grade": "usable", "text": "Usable: it is soft."}).splitlines()
    assert lines[-2] == "Usable: it is soft. 1 photograph is left out: b.jpg."
    assert lines[-1] == "Look at it: splat view run"
    lines = shown(capsys, {"grade": "usable", "text": "It is soft."}, run="my run").splitlines()
    assert lines[-1] == "Look at it: splat view 'my run'"


def test_all_photographs_are_offered_once_quality_is_measured(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def last(grade: str, until: str | None = None, views: int = 21, **settings: bool) -> str:
        text = {"grade": grade, "text": "It is so."}
        return shown(capsys, text, settings, views=views, until=until).splitlines()[-1]

    offered = "Train on all photographs: splat process run --out run-final --no-hold-out"
    assert last("good", hold_out=True) == last("usable", hold_out=True) == offered
    Path("run-final").mkdir()  # an earlier one, which the command would continue
    assert "--out run-final-2 " in last("good", hold_out=True)
    for other in (
        last("wrong", hold_out=True),
        last("good", "train", hold_out=True),
        last("good", views=26, hold_out=True),
        last("good", hold_out=False),
        last("good", hold_out=True, split=True),  # a benchmark's test photographs
    ):
        assert other == "Look at it: splat view run"


def test_a_terminal_breaks_the_verdict_between_words(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = "Usable: " + " ".join(["photographs"] * 20)
    for terminal in (True, False):
        monkeypatch.setattr(console.out, "_force_terminal", terminal)
        lines = shown(capsys, {"grade": "good", "text": text}).splitlines()
        verdict = lines[next(i for i, line in enumerate(lines) if "Usable" in line) : -1]
        assert len(verdict) == (4 if terminal else 1)
        words = re.sub(r"\x1b\[[0-9;]*m", "", " ".join(verdict)).split()
        assert " ".join(words).startswith(text)


def test_memory_is_in_the_unit_of_the_files(capsys: pytest.CaptureFixture[str]) -> None:
    out = shown(capsys, {"grade": "good", "text": "Good."})
    assert "105 MB" in out or "104.9 MB" in out
    assert "MiB" not in out


def test_psnr_and_ssim_have_a_scale_and_a_page_of_the_guide(
    capsys: pytest.CaptureFixture[str],
) -> None:
    stages, _, quality = shown(capsys, {"grade": "good", "text": "Good."}).partition("held-out")
    assert "PSNR" not in stages
    rows = [line.split() for line in quality.splitlines()]
    assert ["mean", "27.11", "dB", "0.8776"] in rows
    assert ["worst:", "IMG_0017.jpg", "23.12", "dB"] in rows
    assert "To an eye: 20 dB" in quality
    (page,) = re.findall(r"docs/guide/\S+", quality)
    file, _, anchor = page.partition("#")
    text = (Path(__file__).parents[2] / file).read_text(encoding="utf-8")
    assert anchor in re.sub(r"[^\w# \n]", "", text.lower()).replace(" ", "-")
    assert max(map(len, quality.splitlines())) <= 80


def test_the_mean_after_pruning_is_told_apart_from_that_after_training(
    capsys: pytest.CaptureFixture[str],
) -> None:
    verdict = {"grade": "good", "text": "Good."}
    rows = shown(capsys, verdict, pruning={"psnr_change_db": -0.884}).splitlines()
    assert ["mean", "27.11", "dB", "0.8776"] in [row.split() for row in rows]
    assert ["mean", "after", "pruning", "26.22", "dB"] in [row.split() for row in rows]
    assert "after pruning" not in shown(capsys, verdict)


@pytest.mark.parametrize("given", [{"steps": 2000}, {"seconds": 60.0}, {"splats": "a.ply"}])
def test_what_the_training_views_decided_is_said(
    capsys: pytest.CaptureFixture[str], given: dict[str, Any]
) -> None:
    good = {"grade": "good", "text": "Good."}
    chosen = "Chosen for 21 training views: 3,150 steps at 640 px,\nand 113,229 of at most 147,000"
    assert chosen in shown(capsys, good)
    assert "Chosen" not in shown(capsys, good, given)


@pytest.mark.parametrize(
    ("views", "steps", "said"), [(21, 3150, True), (21, 2000, False), (60, 9000, False)]
)
def test_more_steps_are_said_to_give_little_only_with_few_views_and_enough_steps_for_each(
    capsys: pytest.CaptureFixture[str], views: int, steps: int, said: bool
) -> None:
    good = {"grade": "good", "text": "Good."}
    words = " ".join(shown(capsys, good, views=views, steps=steps).split())
    assert ("more steps give less than 0.1 dB in the mean" in words) == said
    assert "What more would give: docs/guide/presets.md#what-more" in words


def test_quiet_runs_tell_only_of_a_wrong_result(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console.mode, "quiet", True)
    assert shown(capsys, {"grade": "good", "text": "Good."}) == ""
    assert shown(capsys, {"grade": "wrong", "text": "Wrong, do not use it."}) == ""
