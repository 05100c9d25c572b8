"""Files for other programs, checked before they count."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import formats
from stages.base.errors import Family, SplatError
from stages.base.settings import check_settings
from stages.base.stage import Earlier, Report
from stages.base.text import size
from stages.export import stage as export
from stages.export.settings import ExportSettings
from stages.formats import FORMATS
from stages.formats import mesh_files as files
from stages.formats.mesh_table import MESHES
from stages.mesh import fuse
from stages.proof import checks
from stages.proof.content import FileContent
from stages.prune import stage as prune
from stages.prune.settings import PruneSettings
from stages.quantise import stage as quantise
from stages.quantise.settings import QuantiseSettings
from stages.scene import ExportedAssets, QuantisedSplats, Splats, TrainedSplats
from stages.scene.mesh import Mesh
from tests.small_scene import SmallScene, small_scene

TOO_LARGE = "export-max-mb"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SmallScene:
    return small_scene(tmp_path_factory.mktemp("photos"))


def exported(
    scene: SmallScene,
    folder: Path,
    splats: Splats | None = None,
    earlier: Earlier | None = None,
    **settings: Any,
) -> tuple[ExportedAssets, Report]:
    report = Report(earlier=earlier)
    splats = scene.splats if splats is None else splats
    splats = replace(splats, origin=scene.reconstruction.origin)
    inputs = {
        "sfm": scene.reconstruction,
        "quantise": QuantisedSplats(splats),
    }
    return export.run(inputs, ExportSettings(**settings), folder, report), report


def test_a_file_above_the_size_asked_of_pruning_is_told_and_the_advice_helps(
    scene: SmallScene, tmp_path: Path
) -> None:
    """A smaller --sog-loss-db keeps more bits than pruning reckoned with."""
    asked = 0.006

    def file_and_warnings(max_mb: float, name: str) -> tuple[int, dict[str, str]]:
        inputs: dict[str, Any] = {
            "sfm": scene.reconstruction,
            "train": TrainedSplats(scene.splats),
        }
        stages: tuple[tuple[Any, Any], ...] = (
            (prune, PruneSettings(rounds=0, finetune_steps=0, max_mb=max_mb, mb_of="sog")),
            (quantise, QuantiseSettings(sog_loss_db=0.0, formats=("sog",), rounding_steps=1)),
            (export, ExportSettings(formats=("sog", "ply"))),
        )
        for stage, settings in stages:
            folder, report = tmp_path / name / stage.__name__, Report()
            folder.mkdir(parents=True)
            stage.run(inputs, settings, folder, report)
            inputs[stage.__name__.split(".")[-2]] = stage.load(folder)
        size_bytes = report.metrics["formats"]["sog"]["size_bytes"]
        return size_bytes, dict(report.warnings)

    size_bytes, warnings = file_and_warnings(asked, "asked")
    assert size_bytes > asked * 1e6
    assert f"scene.sog takes {size(size_bytes)}, more than --max-mb 0.006 " in warnings[TOO_LARGE]
    advised = re.search(r"`splat prune --max-mb ([\d.]+)`", warnings[TOO_LARGE])
    assert advised is not None
    size_bytes, warnings = file_and_warnings(float(advised[1]), "advised")
    assert size_bytes <= asked * 1e6


def test_every_format_draws_the_same_picture_again(scene: SmallScene, tmp_path: Path) -> None:
    assets, report = exported(scene, tmp_path, formats=tuple(FORMATS))
    assert [file.format for file in assets.files] == list(FORMATS)
    for file in assets.files:
        figures = report.metrics["formats"][file.format]
        assert (tmp_path / file.path).is_file()
        assert figures["verify_cameras"] == 2  # those held out of ten
        if FORMATS[file.format].loses:
            assert 20 < figures["verify_db"] < 99
            if file.format == "splat":
                assert figures["bytes_per_splat"] == 32
        else:
            assert figures["verify_db"] > 80
            assert figures["max_position_error"] == 0
            assert figures["max_rotation_error_degrees"] < 1e-4
            assert figures["max_sh_error"] == 0
    assert report.metrics["files"] == len(FORMATS)


def test_the_capture_units_and_origin_travel_with_the_files(
    scene: SmallScene, tmp_path: Path
) -> None:
    exported(scene, tmp_path)
    for name in ("ply", "glb", "usdz"):
        back = formats.read(tmp_path / f"scene.{name}")
        np.testing.assert_array_equal(back.origin, [5e5, 0, -4])
    assert b"units: metres" in (tmp_path / "scene.ply").read_bytes()


def test_a_further_format_is_all_that_is_written(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuse, "VOXELS", 24**3)
    before = ("ply", "splat", "gltf", "mesh.glb")
    for folder in ("first", "whole", "added", "changed"):
        (tmp_path / folder).mkdir()
    _, first = exported(scene, tmp_path / "first", formats=before)
    earlier = Earlier(tmp_path / "first", {}, first.metrics, first.warnings, frozenset({"sfm"}))
    _, whole = exported(scene, tmp_path / "whole", formats=(*before, "sog"))
    written: list[str] = []
    write = formats.write

    def noted(path: Path, *given: Any, **more: Any) -> int:
        written.append(path.name)
        return write(path, *given, **more)

    monkeypatch.setattr(formats, "write", noted)
    with monkeypatch.context() as patch:
        patch.setattr(export, "make_collision_mesh", lambda *_: 1 / 0)
        _, added = exported(scene, tmp_path / "added", earlier=earlier, formats=(*before, "sog"))
    assert written == ["scene.sog"]
    assert sorted(added.warnings) == sorted(whole.warnings)
    assert added.metrics == whole.metrics
    names = sorted(path.name for path in (tmp_path / "whole").iterdir())
    assert sorted(path.name for path in (tmp_path / "added").iterdir()) == names
    for name in names:
        assert (tmp_path / "added" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    for changed, inputs in ((scene.splats.take(slice(1, None)), {"sfm"}), (None, set())):
        written.clear()
        other = replace(earlier, same_inputs=frozenset(inputs))
        exported(scene, tmp_path / "changed", changed, other, formats=("ply", "splat"))
        assert written == ["scene.ply", "scene.splat"]


@pytest.mark.slow
def test_equal_inputs_give_equal_files_and_load_gives_the_list(
    scene: SmallScene, tmp_path: Path
) -> None:
    contents = []
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        assets, _ = exported(scene, folder, formats=tuple(FORMATS))
        every = [path for path in folder.rglob("*") if path.is_file()]
        contents.append({path.relative_to(folder): path.read_bytes() for path in every})
        assert export.load(folder) == assets
    assert contents[0] == contents[1]


@pytest.mark.parametrize("name", ["ply", "glb", "usdc"])
@pytest.mark.parametrize("damage", ["quaternion order", "sh", "handedness", "one missing"])
def test_a_wrong_file_does_not_pass(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, damage: str
) -> None:
    """As if the writer had made a common mistake: the check must see each of them."""

    right = checks.read_back

    def wrong(path: Path) -> FileContent:
        content = right(path)
        splats = content.splats
        if damage == "quaternion order":
            splats = replace(splats, quaternions=np.roll(splats.quaternions, 1, axis=1))
        elif damage == "sh":
            sh = splats.sh.copy()
            sh[:, 1:] = sh[:, 1:].reshape(len(sh), 3, -1).transpose(0, 2, 1)
            splats = replace(splats, sh=sh)
        elif damage == "handedness":
            splats = replace(splats, means=splats.means * np.array([-1, 1, 1], np.float32))
        else:
            splats = splats.take(np.arange(1, len(splats)))
        return replace(content, splats=splats)

    monkeypatch.setattr(checks, "read_back", wrong)
    with pytest.raises(SplatError) as caught:
        exported(scene, tmp_path, formats=(name,))
    assert caught.value.code == "export-verify-failed"
    assert caught.value.family == Family.QUALITY
    assert f"scene.{name}" in caught.value.given


def test_a_file_that_another_parser_refuses_does_not_pass(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut_short(path: Path, splats: Splats, **more: Any) -> int:
        path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9\n")
        return 0

    monkeypatch.setattr(formats, "write", cut_short)
    with pytest.raises(SplatError) as caught:
        exported(scene, tmp_path, formats=("ply",))
    assert caught.value.code == "export-verify-failed"


def test_a_bad_8_bit_copy_is_a_warning(scene: SmallScene, tmp_path: Path) -> None:
    sh = scene.splats.sh.copy()
    sh[:, 1:] = np.random.default_rng(0).normal(0, 1.5, sh[:, 1:].shape)
    gaudy = replace(scene.splats, sh=sh)
    _, report = exported(scene, tmp_path, gaudy, formats=("splat", "ply"))
    assert [code for code, _ in report.warnings] == [
        "export-splat-lossy",
        "export-splat-origin",
    ]


def test_splats_out_of_range_are_a_warning(scene: SmallScene, tmp_path: Path) -> None:
    splats = scene.splats.take(np.arange(len(scene.splats)))
    splats.means[4] = 1e7
    _, report = exported(scene, tmp_path, splats, formats=("ply", "spz"))
    assert [code for code, _ in report.warnings] == [
        "export-spz-range",
        "export-spz-origin",
    ]


def test_splats_that_cannot_be_drawn_are_left_out_and_counted(
    scene: SmallScene, tmp_path: Path
) -> None:
    bad = scene.splats.take(np.arange(len(scene.splats)))
    bad.means[0] = np.nan
    bad.sh[1, 0, 2] = np.inf
    _, report = exported(scene, tmp_path, bad)
    assert report.metrics["dropped"] == 2
    assert report.metrics["splats"] == len(bad) - 2
    assert "export-splats-dropped" in [code for code, _ in report.warnings]


def test_a_scene_without_splats_is_exported_with_a_warning(
    scene: SmallScene, tmp_path: Path
) -> None:
    nothing = scene.splats.take(np.zeros(len(scene.splats), bool))
    _, report = exported(scene, tmp_path, nothing, formats=tuple(FORMATS))
    assert [code for code, _ in report.warnings] == ["export-empty"]


@pytest.mark.parametrize("chosen", [("obj",), ("ply", "ksplat"), (), ("PLY",)])
def test_a_format_that_is_not_written_is_refused(chosen: tuple[str, ...]) -> None:
    with pytest.raises(SplatError, match="--format") as caught:
        check_settings(ExportSettings(formats=chosen))
    assert "quantised.glb" in caught.value.wanted


@pytest.mark.parametrize(
    "name",
    [
        "",
        "../up",
        "a/b",
        "a\\b",
        "con:",
        " a",
        "a ",
        ".a",
        "a.",
        "x" * 101,
        "a[b]",
        "assets",
        "a\n",
    ],
)
def test_a_name_that_is_no_file_name_is_refused(name: str) -> None:
    with pytest.raises(SplatError) as caught:
        check_settings(ExportSettings(name=name))
    assert caught.value.family == Family.USAGE


@pytest.mark.parametrize("part", ["compressed", "Mesh", "quantised", "spz", "v4"])
def test_a_name_that_makes_another_format_is_refused(part: str) -> None:
    with pytest.raises(SplatError, match="another format"):
        check_settings(ExportSettings(name=f"a.{part}"))
    check_settings(ExportSettings(name=part))
    check_settings(ExportSettings(name=f"a.{part}-b"))


@pytest.mark.parametrize("ending", FORMATS)
def test_every_name_that_is_taken_keeps_the_format_that_was_requested(ending: str) -> None:
    parts = {part for each in (*FORMATS, *MESHES) for part in each.split(".")}
    for stem in ("scene", *parts, *(f"a.{part}" for part in parts)):
        try:
            check_settings(ExportSettings(name=stem))
        except SplatError:
            continue
        assert formats.format_of(Path(f"{stem}.{ending}")).ending == ending


def test_a_name_with_spaces_and_accents_is_fine(scene: SmallScene, tmp_path: Path) -> None:
    assets, _ = exported(scene, tmp_path, name="Café du Nord", formats=("gltf", "usdz"))
    assert len(assets.files) == 2


def test_mesh_means_both_files_beside_the_splats(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuse, "VOXELS", 48**3)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assets, report = exported(scene, tmp_path / name, formats=("mesh", "ply", "mesh.ply"))
    assert [file.format for file in assets.files] == ["ply", "mesh.glb", "mesh.ply"]
    assert export.load(tmp_path / "b") == assets
    for file in assets.files:
        assert file.size_bytes == (tmp_path / "b" / file.path).stat().st_size
        first, second = ((tmp_path / name / file.path).read_bytes() for name in "ab")
        assert first == second, "equal inputs gave different bytes"
    assert 1000 < report.metrics["mesh"]["triangles"] <= 50_000
    assert 0.5 < report.metrics["mesh"]["covered_share"] <= 1
    header = (tmp_path / "b" / "scene.mesh.ply").read_bytes()[:400]
    assert b"units: metres" in header
    assert b"splat_origin 500000.0 0.0 -4.0" in header


def test_a_mesh_alone_of_as_many_triangles_as_asked(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuse, "VOXELS", 48**3)
    assets, report = exported(scene, tmp_path, formats=("mesh.glb",), mesh_triangles=500)
    assert [file.path for file in assets.files] == ["scene.mesh.glb"]
    assert 400 < report.metrics["mesh"]["triangles"] <= 500


def write_no_mesh(path: Path, mesh: Mesh, units: str) -> None:
    path.write_bytes(b"ply\n")


def test_a_wrong_mesh_does_not_pass(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuse, "VOXELS", 48**3)
    right = files.CODECS_OF_MESHES["mesh.ply"]
    monkeypatch.setitem(files.CODECS_OF_MESHES, "mesh.ply", replace(right, write=write_no_mesh))
    with pytest.raises(SplatError, match=r"scene\.mesh\.ply came out wrong") as caught:
        exported(scene, tmp_path, formats=("mesh.ply",))
    assert (caught.value.code, caught.value.family) == ("export-verify-failed", Family.QUALITY)


def test_no_splats_give_an_empty_mesh(scene: SmallScene, tmp_path: Path) -> None:
    nothing = scene.splats.take(np.zeros(len(scene.splats), bool))
    _, report = exported(scene, tmp_path, nothing, formats=("mesh",))
    assert [code for code, _ in report.warnings] == ["export-empty", "export-mesh-empty"]


def test_export_reads_no_photograph(scene: SmallScene, tmp_path: Path) -> None:
    gone = replace(scene, reconstruction=replace(scene.reconstruction, folder=tmp_path / "gone"))
    assets, _ = exported(gone, tmp_path, formats=tuple(FORMATS))
    assert len(assets.files) == len(FORMATS)


def test_formats_named_twice_are_written_once(scene: SmallScene, tmp_path: Path) -> None:
    assert len(exported(scene, tmp_path, formats=("ply", "ply"))[0].files) == 1
