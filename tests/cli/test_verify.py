"""`splat verify`: what a file is compared with, what is told, and the exit status."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from splatcli.app import app
from splatcli.commands import verify as command
from stages import formats
from stages.base.errors import SplatError
from stages.run import results
from stages.scene import ExportedAssets, ExportedFile, QuantisedSplats, Splats
from stages.train.settings import TrainSettings
from tests.formats.truth import many_splats
from tests.small_scene import SmallScene, small_scene


def verified(*words: object, code: int = 0) -> tuple[str, str]:
    """(standard output, standard error)."""
    runner = CliRunner(env={"COLUMNS": "160"})
    result = runner.invoke(app, ["verify", *map(str, words)])
    assert result.exit_code == code, (result.stdout, result.stderr)
    assert "Unexpected failure" not in result.stderr
    return result.stdout, result.stderr


def events(*words: object, code: int = 0) -> list[dict[str, Any]]:
    out, err = verified(*words, "--json", code=code)
    assert err == ""
    return [json.loads(line) for line in out.splitlines()]


def mirrored(splats: Splats) -> Splats:
    return replace(splats, means=splats.means * np.array([-1, 1, 1], np.float32))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SmallScene:
    made = small_scene(tmp_path_factory.mktemp("photos"))
    skewed = made.splats.means + 0.4 * np.square(made.splats.means)  # no mirror image of itself
    return replace(made, splats=replace(made.splats, means=skewed))


@pytest.fixture
def run(scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run folder whose stages are what the small scene is."""
    folder = tmp_path / "run"
    exported = folder / "7-export"
    exported.mkdir(parents=True)
    (folder / "run.json").write_text("{}")
    names = ("ply", "splat", "glb")
    for name in names:
        formats.write(exported / f"scene.{name}", scene.splats)
    files = tuple(ExportedFile(name, f"scene.{name}", 1) for name in names)
    outputs = {
        "sfm": scene.reconstruction,
        "quantise": QuantisedSplats(scene.splats),
        "export": ExportedAssets(exported, files),
    }

    def pipeline(path: Path) -> SimpleNamespace:
        return SimpleNamespace(
            run_folder=path,
            stage_folder=lambda name: exported,
            manifest=outputs.get,
            load=lambda name: outputs[name],
            check_outputs=lambda: None,
            recorded_settings=lambda: {"train": TrainSettings()},
        )

    monkeypatch.setattr(results, "Pipeline", pipeline)
    monkeypatch.setattr(command, "Pipeline", pipeline)
    return folder


def test_a_file_of_a_run_is_compared_with_what_was_trained(run: Path) -> None:
    *_, found = events(run / "7-export" / "scene.glb")
    assert found["event"] == "verified"
    assert found["against"] == f"the run {run}"
    assert (found["format"], found["splats"], found["right"]) == ("glb", 250, True)
    assert found["verify_db"] > 80
    assert found["verify_cameras"] == 2  # those held out of ten
    assert found["bytes_per_splat"] > 100


def test_a_run_folder_means_all_its_files(run: Path) -> None:
    found = [event for event in events(run) if event["event"] == "verified"]
    assert [each["format"] for each in found] == ["ply", "splat", "glb"]
    out, err = verified(run)
    assert [out.count(f"scene.{each['format']}") for each in found] == [1, 1, 1]
    for words in ("worst PSNR", "mean PSNR", "bytes per", "rotation of splat"):
        assert words in " ".join(out.split())
    assert [line.split()[-1] for line in out.splitlines() if "scene." in line] == 3 * ["right"]
    alone, _ = verified(run / "7-export" / "scene.splat")
    assert "rotation off by, degrees" in alone
    assert "verifying" in err
    assert "itself" not in out + err


def test_files_of_one_run_need_not_be_equal(run: Path, scene: SmallScene) -> None:
    """Each may be fine-tuned to its format."""
    ply, glb = (run / "7-export" / f"scene.{name}" for name in ("ply", "glb"))
    formats.write(ply, mirrored(scene.splats))
    result = CliRunner().invoke(app, ["verify", str(glb), "--against", str(ply)])
    assert result.exit_code == 7
    said = "".join(result.stderr.split())
    assert f"splat verify {glb} --against {run}".replace(" ", "") in said


@pytest.mark.parametrize("beside", [("ply",), ()])
def test_the_meshes_of_a_run_are_not_taken_for_splats(
    run: Path, monkeypatch: pytest.MonkeyPatch, beside: tuple[str, ...]
) -> None:
    names = (*beside, "mesh.glb")
    files = tuple(ExportedFile(name, f"scene.{name}", 1) for name in names)
    assets = ExportedAssets(run / "7-export", files)
    fake = SimpleNamespace(load=lambda name: assets, check_outputs=lambda: None)
    monkeypatch.setattr(command, "Pipeline", lambda path: fake)
    if beside:
        assert command._files(run) == [run / "7-export" / "scene.ply"]
    else:
        with pytest.raises(SplatError, match="meshes only"):
            command._files(run)


@pytest.mark.parametrize("name", ["glb", "gltf", "usdc", "quantised.glb", "ply", "html"])
@pytest.mark.parametrize("written", ["at once", "by convert"])
def test_a_file_far_from_zero_is_right(tmp_path: Path, name: str, written: str) -> None:
    splats = many_splats(500)
    means = (np.float32(1000.5) + 0.1 * splats.means).astype(np.float32)
    far = replace(splats, means=means, origin=np.zeros(3))
    path = tmp_path / f"a.{name}"
    formats.write(path, far)
    if written == "by convert":
        result = CliRunner().invoke(app, ["convert", str(path), str(tmp_path / f"b.{name}")])
        assert result.exit_code == 0, result.stderr
        path = tmp_path / f"b.{name}"
    formats.write(tmp_path / "truth.ply", far)
    verified(path, "--against", tmp_path / "truth.ply")
    verified(tmp_path / "truth.ply", "--against", path)
    verified(path, "--against", path)


def test_a_file_that_lies_elsewhere_is_told(tmp_path: Path) -> None:
    splats = replace(many_splats(50), origin=np.array([5e5, 0.0, 0.0]))
    formats.write(tmp_path / "a.ply", splats)
    formats.write(tmp_path / "b.spz", splats)
    *_, found = events(tmp_path / "b.spz", "--against", tmp_path / "a.ply")
    assert found["warnings"] == []
    (tmp_path / "b.spz.offset.json").unlink()
    *_, found = events(tmp_path / "b.spz", "--against", tmp_path / "a.ply")
    assert "b.spz lies 5e+05 units from" in found["warnings"][0]


def test_verifying_changes_nothing_in_the_run(run: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    verified(run)
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


@pytest.mark.parametrize("name", ["ply", "splat", "glb"])
def test_a_file_that_is_not_what_was_trained_ends_in_exit_status_7(
    run: Path, scene: SmallScene, name: str
) -> None:
    path = run / "7-export" / f"scene.{name}"
    formats.write(path, mirrored(scene.splats))
    *_, found, error = events(path, code=7)
    assert (found["right"], error["code"]) == (False, "verify-failed")
    assert "most positions are wrong, by 0." in error["given"]
    out, err = verified(run, code=7)
    assert "wrong" in out
    assert f"scene.{name} is wrong" in err
    quiet, _ = verified(path, "--quiet", code=7)
    assert quiet.count("\n") == 1


def test_a_file_elsewhere_is_compared_with_a_run_that_is_named(run: Path, tmp_path: Path) -> None:
    formats.write(tmp_path / "copy.spz", formats.read(run / "7-export" / "scene.ply"))
    *_, found = events(tmp_path / "copy.spz", "--against", run)
    assert found["against"] == f"the run {run}"
    assert found["right"]


@pytest.mark.parametrize(
    ("one", "other"),
    [("sog", "ply"), ("spz", "compressed.ply"), ("ply", "sog"), ("splat", "spz"), ("glb", "ply")],
)
def test_a_file_is_compared_with_another_whose_rows_are_sorted_differently(
    scene: SmallScene, tmp_path: Path, one: str, other: str
) -> None:
    for name in (one, other):
        formats.write(tmp_path / f"a.{name}", scene.splats)
    *_, found = events(tmp_path / f"a.{one}", "--against", tmp_path / f"a.{other}")
    assert found["right"]
    assert found["max_position_error"] < 0.02
    assert found["max_opacity_error"] < 0.01
    assert found["max_log_scale_error"] < 0.1


def test_a_file_without_a_run_and_an_original_is_refused(scene: SmallScene, tmp_path: Path) -> None:
    formats.write(tmp_path / "a.spz", scene.splats)
    assert "verify-no-original" in verified(tmp_path / "a.spz", code=2)[1]


def test_a_visible_loss_is_a_warning_and_no_failure(scene: SmallScene, tmp_path: Path) -> None:
    sh = scene.splats.sh.copy()
    sh[:, 1:] = np.random.default_rng(0).normal(0, 1.5, sh[:, 1:].shape)
    gaudy = replace(scene.splats, sh=sh)
    formats.write(tmp_path / "a.ply", gaudy)
    formats.write(tmp_path / "a.splat", gaudy)
    _, err = verified(tmp_path / "a.splat", "--against", tmp_path / "a.ply")
    assert "Warning: Pictures of a.splat" in err
    assert "do not change with the view" in err


@pytest.mark.parametrize("name", [name for name in formats.FORMATS if name not in ("usda", "usdc")])
@pytest.mark.parametrize("damage", ["garbage", "cut short", "empty"])
def test_a_damaged_file_is_reported(
    scene: SmallScene, tmp_path: Path, name: str, damage: str
) -> None:
    path = tmp_path / f"a.{name}"
    formats.write(path, scene.splats)
    whole = path.read_bytes()
    cut = whole[: len(whole) * 2 // 3 + 1]  # no multiple of the records' 32 bytes
    path.write_bytes(
        {"garbage": b"\x00garbage" * 99 + b".", "cut short": cut, "empty": b""}[damage]
    )
    out, err = verified(path, code=3)
    assert out == ""
    assert "splats-unreadable" in err


def test_a_format_that_cannot_be_verified_is_reported_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0")
    assert "format-unknown" in verified(tmp_path / "a.obj", code=2)[1]
    assert "splats-unreadable" in verified(tmp_path / "none.ply", code=3)[1]
    assert "run-folder-missing" in verified(tmp_path, code=5)[1]
    (tmp_path / "a.splat").write_bytes(bytes(32))
    folder = tmp_path / "folder"
    folder.mkdir()
    assert "run-folder-missing" in verified(tmp_path / "a.splat", "--against", folder, code=5)[1]


@pytest.mark.parametrize(
    "words",
    [
        ["--photos", "photos"],
        ["scene.ply", "--photos", "photos", "--against", "other.ply"],
        ["scene.ply", "--cameras", "sparse"],
    ],
)
def test_photographs_are_an_original_of_their_own(words: list[str]) -> None:
    _, err = verified(*words, code=2)
    assert "splat verify FILE --photos PHOTOS --cameras MODEL" in err


def test_splats_are_not_measured_on_photographs_without_their_cameras(
    scene: SmallScene, tmp_path: Path
) -> None:
    path = tmp_path / "scene.ply"
    formats.write(path, scene.splats)
    _, err = verified(path, "--photos", scene.reconstruction.folder, code=2)
    assert "seed-splats-without-cameras" in err
