"""Photographs in, assets out: the real stages, on the sample capture, as a person runs them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.sample import FORMATS, PHOTO_COUNT, events, process_words, splat

pytestmark = pytest.mark.slow

PSNR_OF_A_BLUR_DB = 15.0  # far below what training reaches, far above a wrong pose or a grey image


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sample")


@pytest.fixture(scope="module")
def result(folder: Path) -> dict[str, Any]:
    formats = [word for name in FORMATS for word in ("--format", name)]
    last = events(splat(*process_words(*formats, "--json"), folder=folder))[-1]
    assert last["event"] == "result"
    return last


def metrics(result: dict[str, Any], stage: str) -> dict[str, Any]:
    found: dict[str, Any] = result["stages"][stage]["metrics"]
    return found


def test_every_photograph_is_registered(result: dict[str, Any]) -> None:
    assert metrics(result, "sfm")["registered"] == PHOTO_COUNT
    assert metrics(result, "sfm")["mean_reprojection_error_px"] < 1.0


def test_held_out_photographs_are_recognisable(result: dict[str, Any]) -> None:
    assert metrics(result, "train")["psnr_db"] > PSNR_OF_A_BLUR_DB


def test_every_format_is_there_and_not_empty(result: dict[str, Any], folder: Path) -> None:
    assets = [folder / asset["path"] for asset in result["assets"]]
    assert {path.suffix.removeprefix(".") for path in assets} == set(FORMATS)
    assert all(path.stat().st_size > 1000 for path in assets)


def test_ply_reads_in_plyfile(result: dict[str, Any], folder: Path) -> None:
    from plyfile import PlyData

    (path,) = [a["path"] for a in result["assets"] if a["path"].endswith(".ply")]
    vertices = PlyData.read(folder / path)["vertex"]
    assert 500 < len(vertices) <= 8000
    for name in ("x", "opacity", "scale_0", "rot_0", "f_dc_0"):
        assert np.isfinite(vertices[name]).all(), name


def test_seconds_and_memory_of_every_stage_are_accounted_for(result: dict[str, Any]) -> None:
    for name, stage in result["stages"].items():
        assert stage["seconds"] > 0, name
        assert 20 < stage["peak_memory_mib"] < 8000, name


def test_second_run_has_nothing_to_do(result: dict[str, Any], folder: Path) -> None:
    formats = [word for name in FORMATS for word in ("--format", name)]
    again = events(splat(*process_words(*formats, "--json"), folder=folder))
    assert not [event for event in again if event["event"] == "started"]


def test_status_info_and_render_work_on_the_run(result: dict[str, Any], folder: Path) -> None:
    from PIL import Image

    (status,) = events(splat("status", "--json", folder=folder))
    assert {row["state"] for row in status["stages"]} == {"finished"}
    (info,) = events(splat("info", "--json", folder=folder))
    assert info["photographs"] == PHOTO_COUNT
    assert info["splats"] > 500
    done = splat("render", "--camera", "3", "--width", "200", "--out", "view.png", folder=folder)
    assert done.returncode == 0, done.stderr
    pixels = np.asarray(Image.open(folder / "view.png"), np.float64)
    assert pixels.shape[1:] == (200, 3)
    assert 140 <= pixels.shape[0] <= 160  # 3:4 but for the undistortion
    assert pixels.std() > 10  # a picture, not a flat colour


def test_info_reads_every_asset(result: dict[str, Any], folder: Path) -> None:
    counts = {}
    for asset in result["assets"]:
        (info,) = events(splat("info", asset["path"], "--json", folder=folder))
        counts[asset["path"]] = info["splats"]
    assert len(set(counts.values())) == 1, counts


def test_verify_finds_what_the_manifest_says(result: dict[str, Any], folder: Path) -> None:
    found = events(splat("verify", "--json", folder=folder))
    found = [event for event in found if event["event"] == "verified"]
    assert [each["format"] for each in found] == list(FORMATS)
    for each in found:
        assert each["right"], each["fault"]
        kept = metrics(result, "export")["formats"][each["format"]]
        assert {name: each[name] for name in kept} == kept


def test_asking_for_a_format_that_is_there_runs_nothing_and_loses_none(
    result: dict[str, Any], folder: Path
) -> None:
    ran = events(splat("export", "--format", "ply", "--json", folder=folder))
    assert [event["stage"] for event in ran if event["event"] == "started"] == []
    manifest = json.loads((folder / "run" / "7-export" / "manifest.json").read_text())
    assert sorted(manifest["settings"]["formats"]) == sorted(FORMATS)
