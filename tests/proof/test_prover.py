"""A file is proven by what it draws and by every value in it; mistakes are seen and measured."""

from __future__ import annotations

import base64
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from stages import formats
from stages.base.errors import SplatError
from stages.formats import splat32
from stages.formats.values import check_finite
from stages.proof import prover as proving
from stages.proof import usd_validation
from stages.proof.checks import read_back
from stages.proof.prover import Proof, Prover, cameras_for
from stages.scene import Splats
from tests.formats.files import read
from tests.small_scene import SmallScene, small_scene

Change = Callable[[Splats], Splats]
DIFFERENT_KINDS = ("ply", "splat", "glb", "spz", "sog", "compressed.ply")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SmallScene:
    """A ball of splats that is no mirror image of itself, where most change with the view."""
    made = small_scene(tmp_path_factory.mktemp("photos"))
    rng = np.random.default_rng(7)
    n = len(made.splats)
    means = made.splats.means + 0.4 * np.square(made.splats.means)
    sh = made.splats.sh.copy()
    sh[:, 1:] = rng.normal(0, 0.25, (n, 8, 3))
    return replace(made, splats=replace(made.splats, means=means, sh=sh))


@pytest.fixture(scope="module")
def prover(scene: SmallScene) -> Prover:
    return Prover.of(scene.splats, cameras_for(scene.splats, scene.reconstruction.views))


def written(prover: Prover, folder: Path, name: str, splats: Splats) -> Proof:
    formats.write(folder / f"a.{name}", splats)
    return prover.prove(folder / f"a.{name}")


def turned_about_x(splats: Splats) -> Splats:
    return replace(splats, means=splats.means * np.array([1, -1, -1], np.float32))


def mirrored(splats: Splats) -> Splats:
    return replace(splats, means=splats.means * np.array([-1, 1, 1], np.float32))


def rolled(splats: Splats) -> Splats:
    return replace(splats, quaternions=np.roll(splats.quaternions, -1, axis=1))


def interleaved(splats: Splats) -> Splats:
    n, k = len(splats), splats.sh.shape[1] - 1
    sh = splats.sh.copy()
    # read as all coefficients of red first, although written red, green, blue, red, ...
    sh[:, 1:] = sh[:, 1:].reshape(n, 3, k).transpose(0, 2, 1)
    return replace(splats, sh=sh)


def shrunk(splats: Splats) -> Splats:
    return replace(splats, means=splats.means / 10, log_scales=splats.log_scales - np.log(10))


def moved(splats: Splats) -> Splats:
    return replace(splats, means=splats.means + np.array([7, 0, 0], np.float32))


@pytest.mark.parametrize("name", formats.FORMATS)
def test_what_was_written_is_proven_in_every_format(
    prover: Prover, scene: SmallScene, tmp_path: Path, name: str
) -> None:
    proof = written(prover, tmp_path, name, scene.splats)
    assert proof.fault == ""
    assert proof.splats == len(scene.splats)
    assert proof.figures["verify_db"] <= proof.figures["verify_mean_db"] <= 99
    assert proof.figures["verify_cameras"] == 2  # of ten photographs two are held out
    if not formats.FORMATS[name].loses:
        assert proof.figures["verify_db"] > 80
        assert proof.figures["worst_attribute"] == ""


@pytest.mark.parametrize("name", formats.FORMATS)
def test_what_was_read_back_is_drawn_by_kernels_that_are_compiled(
    scene: SmallScene, tmp_path: Path, name: str
) -> None:
    formats.write(tmp_path / f"a.{name}", scene.splats)
    found = read_back(tmp_path / f"a.{name}").splats
    for array in (found.means, found.quaternions, found.log_scales, found.opacity_logits, found.sh):
        assert array.flags.writeable  # for others, they are compiled anew
        assert array.flags.c_contiguous


@pytest.mark.parametrize("name", DIFFERENT_KINDS)
def test_the_order_of_the_rows_does_not_matter(
    prover: Prover, scene: SmallScene, tmp_path: Path, name: str
) -> None:
    rows = np.random.default_rng(2).permutation(len(scene.splats))
    same = written(prover, tmp_path, name, scene.splats).figures
    other = written(prover, tmp_path, name, scene.splats.take(rows)).figures
    for figure in ("max_position_error", "max_opacity_error", "max_rotation_error_degrees"):
        assert other[figure] == pytest.approx(same[figure], rel=0.05, abs=1e-6), figure


@pytest.mark.parametrize("name", DIFFERENT_KINDS)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (mirrored, "most positions are wrong, by "),
        (turned_about_x, "most positions are wrong, by "),
        (moved, "most positions are wrong, by "),
        (shrunk, "most positions are wrong, by "),
        (rolled, "most rotations are wrong, by "),
        (interleaved, "most view-dependent colours are wrong, by 1"),  # 180 %
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_a_common_mistake_of_a_writer_is_seen(
    prover: Prover, scene: SmallScene, tmp_path: Path, name: str, change: Change, words: str
) -> None:
    proof = written(prover, tmp_path, name, change(scene.splats))
    if name == "splat" and change is interleaved:  # it has no view-dependent colours
        assert proof.fault == ""
    else:
        assert words in proof.fault


def test_bytes_of_f_rest_in_the_wrong_order_are_seen(
    prover: Prover, scene: SmallScene, tmp_path: Path
) -> None:
    """The mistake as it is made: another writer's column order under the right names."""
    formats.write(tmp_path / "a.ply", scene.splats)
    data = PlyData.read(tmp_path / "a.ply", mmap=False)
    names = [f"f_rest_{i}" for i in range(24)]
    columns = np.stack([data["vertex"][name].copy() for name in names], axis=1)
    in_turn = columns.reshape(-1, 3, 8).transpose(0, 2, 1).reshape(-1, 24)
    for name, column in zip(names, in_turn.T, strict=True):
        data["vertex"][name] = column
    data.write(tmp_path / "a.ply")
    proof = prover.prove(tmp_path / "a.ply")
    assert "most view-dependent colours are wrong, by " in proof.fault
    assert proof.figures["verify_db"] < 45


@pytest.mark.parametrize(
    ("column", "add", "attribute", "figure"),
    [
        ("x", 0.5, "position", "max_position_error"),
        ("scale_1", 0.5, "log_scale", "max_log_scale_error"),
        ("f_rest_3", 0.5, "sh", "max_sh_error"),
    ],
)
def test_one_altered_value_is_named(
    prover: Prover,
    scene: SmallScene,
    tmp_path: Path,
    column: str,
    add: float,
    attribute: str,
    figure: str,
) -> None:
    formats.write(tmp_path / "a.ply", scene.splats)
    data = PlyData.read(tmp_path / "a.ply", mmap=False)
    data["vertex"][column][123] += add
    data.write(tmp_path / "a.ply")
    found = prover.prove(tmp_path / "a.ply").figures
    assert (found["worst_attribute"], found["worst_splat"]) == (attribute, 123)
    assert found[figure] == pytest.approx(add, rel=1e-3)
    others = [name for name in found if name.startswith("max_") and name != figure]
    assert [found[name] for name in others] == [0, 0, 0, 0]


def test_one_altered_opacity_is_named(prover: Prover, scene: SmallScene, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    splats = replace(scene.splats, opacity_logits=scene.splats.opacity_logits.copy())
    splats.opacity_logits[40] = 0 if abs(splats.opacity_logits[40]) > 1 else 3
    formats.write(path, splats)
    found = prover.prove(path).figures
    assert (found["worst_attribute"], found["worst_splat"]) == ("opacity", 40)


@pytest.mark.parametrize("name", formats.FORMATS)
def test_a_missing_splat_is_counted(
    prover: Prover, scene: SmallScene, tmp_path: Path, name: str
) -> None:
    n = len(scene.splats)
    proof = written(prover, tmp_path, name, scene.splats.take(np.arange(1, n)))
    assert proof.fault == f"it holds {n - 1} of {n} splats"


def test_one_splat_twice_for_another_is_found_though_the_count_is_right(
    prover: Prover, scene: SmallScene, tmp_path: Path
) -> None:
    rows = np.arange(len(scene.splats))
    rows[30] = 31
    found = written(prover, tmp_path, "ply", scene.splats.take(rows)).figures
    assert found["max_position_error"] > 0.01
    assert found["worst_attribute"]


@pytest.mark.parametrize("name", ["splat", "spz", "sog", "compressed.ply"])
def test_a_file_equals_what_was_read_from_it(scene: SmallScene, tmp_path: Path, name: str) -> None:
    path = tmp_path / f"a.{name}"
    formats.write(path, scene.splats)
    back = formats.read(path)
    prover = Prover.of(back, cameras_for(back), source_format=name)
    proof = prover.prove(path)
    assert (proof.fault, proof.loss_db) == ("", None)
    assert proof.figures["verify_db"] > 80


def in_itself(path: Path) -> None:
    """Rewrite a .gltf with its buffer inside."""
    document = json.loads(path.read_text())
    body = base64.b64encode(path.with_suffix(".bin").read_bytes()).decode()
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + body
    path.write_text(json.dumps(document))


def of_postshot(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"SplatRenderMode: mip", b"antialiased 1"))


def without_note(path: Path) -> None:
    text = path.read_text()
    path.write_text(text[: text.index("customLayerData")] + text[text.index("defaultPrim") :])


def of_splat_transform(path: Path) -> None:
    with zipfile.ZipFile(path) as package:
        members = {name: package.read(name) for name in package.namelist()}
    meta = json.loads(members["meta.json"])
    del meta["antialias"]
    with zipfile.ZipFile(path, "w") as package:
        for name, content in (members | {"meta.json": json.dumps(meta)}).items():
            package.writestr(name, content)


def renamed(path: Path) -> None:
    formats.write(path.with_name("b.compressed.ply"), formats.read(path))
    path.with_name("b.compressed.ply").replace(path)


def placed(path: Path) -> None:
    document = json.loads(path.read_text())
    document["nodes"][0]["translation"] = [1, 2, 3]
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("name", "change", "unchecked"),
    [
        ("gltf", in_itself, ""),
        ("gltf", placed, "nodes that place splats"),
        ("ply", of_postshot, ""),
        ("ply", renamed, ""),
        ("sog", of_splat_transform, ""),
        pytest.param("usda", without_note, "", marks=pytest.mark.slow),
    ],
)
def test_a_file_of_another_program_is_right_or_not_understood(
    scene: SmallScene, tmp_path: Path, name: str, change: Callable[[Path], None], unchecked: str
) -> None:
    path = tmp_path / f"a.{name}"
    formats.write(path, scene.splats.with_antialias(name != "usda"))
    change(path)
    splats = read(path)
    prover = Prover.of(splats, cameras_for(splats))
    proof = prover.prove(path)
    assert unchecked in proof.fault
    if not unchecked:
        assert proof.fault == ""
        assert proof.figures["verify_db"] > 45


def test_flat_and_opaque_splats_are_numbers_to_both_readers(
    scene: SmallScene, tmp_path: Path
) -> None:
    """Other programs write a scale of 0 and an opacity of 1."""
    records = splat32.encode(scene.splats)
    records["scale"][:, 2] = 0
    records["rgba"][:9, 3] = 255
    (tmp_path / "a.splat").write_bytes(records.tobytes())
    back = formats.read(tmp_path / "a.splat")
    proof = Prover.of(back, cameras_for(back), source_format="splat").prove(tmp_path / "a.splat")
    assert proof.fault == ""
    assert proof.splats == len(scene.splats)
    assert proof.figures["max_log_scale_error"] == 0


@pytest.mark.parametrize("name", ["spz", "sog", "compressed.ply", "quantised.glb"])
@pytest.mark.parametrize("thickness", [-16.0, -np.inf])
def test_an_axis_too_thin_for_a_format_is_no_fault(
    prover: Prover, scene: SmallScene, tmp_path: Path, name: str, thickness: float
) -> None:
    logs = scene.splats.log_scales.copy()
    logs[:, 2] = thickness
    flat = check_finite(replace(scene.splats, log_scales=logs))
    found = written(Prover.of(flat, prover.cameras), tmp_path, name, flat)
    assert found.fault == ""
    assert found.figures["verify_db"] > 30


def test_splats_smaller_than_a_format_holds_are_named_with_its_limit(
    scene: SmallScene, tmp_path: Path
) -> None:
    tiny = scene.splats
    tiny = replace(tiny, means=tiny.means / 1e4, log_scales=tiny.log_scales - np.log(1e4))
    formats.write(tmp_path / "a.spz", tiny)
    with pytest.raises(SplatError, match=r"holds sizes from 4\.5e-05 to 379 units") as wrong:
        Prover.of(tiny, cameras_for(tiny)).require(tmp_path / "a.spz", "wrong")
    assert "--scale 1e1" in wrong.value.hint


def test_without_photographs_the_middle_of_the_splats_is_seen_from_three_sides(
    scene: SmallScene,
) -> None:
    cameras = cameras_for(scene.splats)
    assert len(cameras) == 3
    low, high = np.quantile(scene.splats.means, (0.25, 0.75), axis=0)
    middle = (low + high) / 2
    bearings = []
    for camera in cameras:
        assert max(camera.width, camera.height) == 480
        x, y, z = camera.world_to_camera[:3] @ [*middle, 1]
        assert z > 0
        np.testing.assert_allclose([x, y], 0, atol=1e-6)
        bearings.append(np.arctan2(*(camera.centre - middle)[[0, 2]]))
    gaps = np.diff(np.unwrap(np.sort(bearings)))
    np.testing.assert_allclose(np.degrees(gaps), 120, atol=1e-6)


@pytest.mark.parametrize("name", ["usda", "usdc", "usdz"])
def test_the_usd_librarys_validators_find_no_errors(
    scene: SmallScene, tmp_path: Path, name: str
) -> None:
    formats.write(tmp_path / f"a.{name}", scene.splats)
    assert usd_validation.usd_errors(tmp_path / f"a.{name}") == []


@pytest.mark.parametrize("name", ["usda", "usdc", "usdz"])
def test_usd_is_proven_below_a_folder_whose_name_has_two_lines(
    prover: Prover, scene: SmallScene, tmp_path: Path, name: str
) -> None:
    path = tmp_path / "two\nlines" / f"a.{name}"
    path.parent.mkdir()
    formats.write(path, scene.splats)
    assert len(formats.read(path)) == len(scene.splats)
    assert prover.prove(path).fault == ""


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ('upAxis = "Y"', "", "UpAxis"),
        ('defaultPrim = "Scene"', "", "DefaultPrim"),
        ("float[] opacities", "double[] opacities", "TypeMismatch"),
    ],
)
def test_what_the_usd_librarys_validators_find_is_a_fault(
    prover: Prover, scene: SmallScene, tmp_path: Path, old: str, new: str, word: str
) -> None:
    path = tmp_path / "a.usda"
    formats.write(path, scene.splats)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    assert word in prover.prove(path).fault


@pytest.mark.parametrize("name", ["ply", "sog"])
def test_of_very_many_splats_the_middle_is_drawn_and_all_are_compared(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(proving, "_MAX_DRAWN", len(scene.splats) // 2)
    cameras = cameras_for(scene.splats, scene.reconstruction.views)
    some = Prover.of(scene.splats, cameras)
    right = written(some, tmp_path, name, scene.splats)
    assert not right.fault
    assert right.figures["verify_db"] > 30
    assert isinstance(some.drawn, np.ndarray)
    assert np.count_nonzero(some.drawn) == len(scene.splats) // 2
    far = scene.splats.means.copy()
    outside = int(np.flatnonzero(~some.drawn)[0])
    far[outside] += 100
    wrong = written(some, tmp_path, name, replace(scene.splats, means=far))
    assert wrong.figures["max_position_error"] > 50


def test_advice_for_splats_on_a_map_grid_works(scene: SmallScene, tmp_path: Path) -> None:
    """Steps of 1 unit are all that 24 bits hold there."""
    shift = np.array([500_000, -100, 5_500_000], np.float32)
    far = replace(scene.splats, means=scene.splats.means + shift)
    formats.write(tmp_path / "far.spz", far)
    with pytest.raises(SplatError) as error:
        Prover.of(far, cameras_for(far)).require(tmp_path / "far.spz", "wrong")
    assert error.value.hint.startswith("`splat edit --move=-500000,100,-5500000` brings them")
    near = replace(far, means=far.means - shift)
    formats.write(tmp_path / "near.spz", near)
    assert Prover.of(near, cameras_for(near)).require(tmp_path / "near.spz", "wrong").splats
