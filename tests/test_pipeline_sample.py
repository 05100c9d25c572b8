"""Photographs in, assets out: the real stages, on the sample capture, as a person runs them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import sample
from tests.sample import FORMATS, PHOTO_COUNT, events, process_words, splat

pytestmark = pytest.mark.slow


@pytest.fixture
def result(sample_run: Path) -> dict[str, Any]:
    last = sample.told(sample_run)[-1]
    assert last["event"] == "result"
    return last


@pytest.fixture
def copied(sample_run: Path, tmp_path: Path) -> Path:
    """The folder of a run/ that may be changed."""
    return sample.copied(sample_run, tmp_path)


def metrics(result: dict[str, Any], stage: str) -> dict[str, Any]:
    found: dict[str, Any] = result["stages"][stage]["metrics"]
    return found


def test_every_photograph_is_registered(result: dict[str, Any]) -> None:
    assert metrics(result, "sfm")["registered_images"] == PHOTO_COUNT
    assert metrics(result, "sfm")["mean_reprojection_error_px"] < 1.0


def test_held_out_photographs_are_recognisable(result: dict[str, Any]) -> None:
    low, high = sample.PSNR_DB
    assert low < metrics(result, "train")["psnr_db"] < high


def test_every_format_is_there_and_not_empty(result: dict[str, Any], sample_run: Path) -> None:
    assets = [sample_run / asset["path"] for asset in result["assets"]]
    assert {path.suffix.removeprefix(".") for path in assets} == set(FORMATS)
    assert all(path.stat().st_size > 1000 for path in assets)


def test_ply_reads_in_plyfile(result: dict[str, Any], sample_run: Path) -> None:
    from plyfile import PlyData

    (path,) = [a["path"] for a in result["assets"] if a["path"].endswith(".ply")]
    vertices = PlyData.read(sample_run / path)["vertex"]
    assert len(vertices) == metrics(result, "prune")["splats"]
    for name in ("x", "opacity", "scale_0", "rot_0", "f_dc_0"):
        assert np.isfinite(vertices[name]).all(), name
        assert np.std(vertices[name]) > 0, name


def test_seconds_and_memory_of_every_stage_are_accounted_for(
    result: dict[str, Any], sample_run: Path
) -> None:
    stages = result["stages"]
    seconds = [stage["seconds"] for stage in stages.values()]
    elapsed_s = sample.elapsed_s(sample_run)
    assert min(seconds) > 0
    assert 0.6 * elapsed_s < sum(seconds) < elapsed_s  # the rest is starting and looking around
    for name, stage in stages.items():
        assert 20 < stage["peak_memory_mib"] < 8000, name


def test_second_run_has_nothing_to_do(copied: Path) -> None:
    formats = [word for name in FORMATS for word in ("--format", name)]
    again = events(splat(*process_words(*formats, "--json"), folder=copied))
    assert [event["event"] for event in again].count("skipped") == 7
    assert not [event for event in again if event["event"] == "started"]


def test_status_info_and_render_work_on_the_run(copied: Path) -> None:
    from PIL import Image

    (status,) = events(splat("status", "--json", folder=copied))
    assert {row["state"] for row in status["stages"]} == {"finished"}
    (info,) = events(splat("info", "--json", folder=copied))
    assert info["photographs"] == PHOTO_COUNT
    assert info["splats"] > 500
    done = splat("render", "--camera", "3", "--width", "200", "--out", "view.png", folder=copied)
    assert done.returncode == 0, done.stderr
    pixels = np.asarray(Image.open(copied / "view.png"), np.float64)
    assert pixels.shape[1:] == (200, 3)
    assert 140 <= pixels.shape[0] <= 160  # 3:4 but for the undistortion
    assert pixels.std() > 10  # a picture, not a flat colour


def test_info_reads_every_asset(result: dict[str, Any], sample_run: Path) -> None:
    counts = {}
    for asset in result["assets"]:
        (info,) = events(splat("info", asset["path"], "--json", folder=sample_run))
        counts[asset["path"]] = info["splats"]
    assert set(counts.values()) == {metrics(result, "prune")["splats"]}, counts


def test_verify_finds_what_the_manifest_says(result: dict[str, Any], copied: Path) -> None:
    found = events(splat("verify", "--json", folder=copied))
    found = [event for event in found if event["event"] == "verified"]
    assert [each["format"] for each in found] == list(FORMATS)
    for each in found:
        assert each["right"], each["fault"]
        figures = metrics(result, "export")["formats"][each["format"]]
        measured = {name: value for name, value in figures.items() if name != "made_from"}
        assert {name: each[name] for name in measured} == measured


def test_asking_for_one_more_lossless_format_runs_export_alone(copied: Path) -> None:
    ran = events(splat("export", "--format", "html", "--json", folder=copied))
    assert [event["stage"] for event in ran if event["event"] == "started"] == ["export"]


def test_asking_for_a_format_that_rounds_has_quantise_finetune_to_it(copied: Path) -> None:
    words = ("--format", "sog", "--format", "usdz", "--json")
    ran = events(splat("export", *words, folder=copied))
    assert [event["stage"] for event in ran if event["event"] == "started"] == [
        "quantise",
        "export",
    ]
    assert (copied / "run" / "6-quantise" / "finetuned" / "sog").is_dir()
    assert (copied / "run" / "7-export" / "scene.sog").is_file()


def test_asking_for_a_format_that_is_there_runs_nothing_and_loses_none(copied: Path) -> None:
    ran = events(splat("export", "--format", "ply", "--json", folder=copied))
    assert [event["stage"] for event in ran if event["event"] == "started"] == []
    manifest = json.loads((copied / "run" / "7-export" / "manifest.json").read_text())
    assert sorted(manifest["settings"]["formats"]) == sorted(FORMATS)


def test_a_file_is_measured_on_photographs_as_the_run_measured_it(
    result: dict[str, Any], copied: Path
) -> None:
    """The photographs that structure from motion undistorted, and its model of them."""
    model = copied / "model"  # of another program, as far as this command can know
    shutil.copytree(copied / "run" / "2-sfm" / "colmap", model)
    words = ("--photos", str(model / "images"), "--cameras", str(model / "sparse" / "0"), "--json")
    (found,) = (
        event
        for event in events(splat("verify", "run/7-export/scene.ply", *words, folder=copied))
        if event["event"] == "verified"
    )
    assert found["given_world"] == "the cameras' world"
    assert found["given_drawing"] == "plain"
    assert found["splats"] == metrics(result, "prune")["splats"]
    low, high = sample.PSNR_DB
    # Trained at a quarter of 640 pixels and fine-tuned for plain drawing there; the photographs
    # were compressed twice. Measured: 23.3 dB, as in training.
    assert low < found["psnr_quarter_db"] < high
    assert found["warnings"][0].startswith("The given splats may have been trained on 3")


def test_a_second_run_goes_on_from_the_first(result: dict[str, Any], copied: Path) -> None:
    words = ("process", "run", "--out", "more", "--splats", "run")
    still = events(splat(*words, "--json", folder=copied))[-1]
    assert metrics(still, "train")["psnr_db"] == pytest.approx(
        metrics(result, "train")["psnr_db"], abs=0.002
    )
    further = events(splat(*words, "--steps", "100", "--json", folder=copied))[-1]
    assert metrics(further, "train")["steps"] == 100
    assert metrics(further, "train")["psnr_db"] > metrics(result, "train")["psnr_db"] - 0.2
    assert further["verdict"]["grade"] == result["verdict"]["grade"]
