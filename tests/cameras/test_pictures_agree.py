"""Handedness and axes are right because pictures say so.

Known points are drawn into photographs by the formula that each format's own description gives,
or by a library of others, and must be found there by the cameras that were read.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from PIL import Image

from stages.base.bad_files import CAMERAS
from stages.base.errors import SplatError
from stages.cameras.camera_formats import CAMERA_FILES, files_of, read_cameras, read_points
from tests.cameras import drawn, drawn_surveys
from tests.cameras.drawn import (
    COLOURS,
    EYES,
    HEIGHT,
    NAMES,
    POINTS,
    POSES,
    WIDTH,
    blender,
    nerfstudio,
)
from tests.cameras.drawn_surveys import MADE, polycam
from tests.cameras.models import example


def test_every_format_of_the_table_is_drawn() -> None:
    assert set(MADE) == {row.read.__module__.rpartition(".")[2] for row in CAMERA_FILES}


def test_the_page_that_the_error_names_lists_every_format() -> None:
    found = re.search(r"formats that (\S+\.md) lists", CAMERAS.wanted)
    assert found
    page = (Path(__file__).parents[2] / found[1]).read_text(encoding="utf-8")
    assert [row.description for row in CAMERA_FILES if row.description not in page] == []


@pytest.mark.parametrize("name", [*MADE, "polycam"])
def test_points_are_where_the_pictures_show_them(tmp_path: Path, name: str) -> None:
    found = read_cameras((MADE | {"polycam": polycam})[name](tmp_path))
    assert len(found.views) == len(POSES)
    for view, lens in zip(found.views, found.lenses, strict=True):
        image = found.folder / view.image
        image = image if image.exists() else image.with_suffix(".png")
        if not image.exists():
            (image,) = tmp_path.rglob(Path(view.image).name)
        picture = np.asarray(Image.open(image))
        camera = view.camera
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        at = POINTS @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        assert (at[:, 2] > 0).all()
        uv = lens.distort(at[:, :2] / at[:, 2:])
        px = np.floor(uv * (camera.fx, camera.fy) + (camera.cx, camera.cy)).astype(int)
        hit = [
            np.abs(picture[y, x].astype(int) - colour).max() == 0
            for (x, y), colour in zip(px, COLOURS, strict=True)
        ]
        assert np.mean(hit) >= 0.8  # discs may cover each other


@pytest.mark.parametrize("name", ["colmap", "opensfm", "bundler", "inria"])
def test_points_of_the_file_are_in_the_cameras_world(tmp_path: Path, name: str) -> None:
    found = read_points(MADE[name](tmp_path))
    assert found is not None
    order = [int(np.argmin(np.abs(POINTS - p).sum(axis=1))) for p in found.points]
    np.testing.assert_allclose(found.points, POINTS[order], atol=1e-9)
    np.testing.assert_array_equal(found.colours, COLOURS[order])
    assert sorted(order) == list(range(len(POINTS)))


def test_a_benchmarks_split_is_read(tmp_path: Path) -> None:
    roles = [view.role for view in read_cameras(blender(tmp_path)).views]
    assert roles == ["train", "train", "val", "test"]


def test_a_benchmark_without_its_validation_pictures_is_read(tmp_path: Path) -> None:
    folder = blender(tmp_path)
    for path in (folder / "train").iterdir():
        if path.stem not in ("p_0", "p_1", "p_2"):
            path.unlink()
    sizes = {(v.camera.width, v.camera.height) for v in read_cameras(folder).views}
    assert len(sizes) == 1


def test_nerfstudios_split_is_read(tmp_path: Path) -> None:
    path = nerfstudio(tmp_path)
    data = json.loads(path.read_text())
    data["train_filenames"] = ["images/p_0.png", "images/p_1.png"]
    data["test_filenames"] = ["images/p_2.png"]
    path.write_text(json.dumps(data))
    assert [view.role for view in read_cameras(path).views] == ["train", "train", "test", ""]


def test_nerfstudios_points_come_back_into_the_cameras_world(tmp_path: Path) -> None:
    from stages.cameras.nerfstudio import write

    views = read_cameras(nerfstudio(tmp_path)).views
    target = tmp_path / "again.json"
    write(target, views, tmp_path, POINTS, COLOURS)
    found = read_points(target)
    assert found is not None
    np.testing.assert_allclose(found.points, POINTS, atol=1e-6)
    (tmp_path / "splats.ply").write_bytes(b"")
    assert {path.name for path in files_of(target)} == {"again.json", "again_points.ply"}


def test_files_beside_a_colmap_model_are_no_part_of_it(tmp_path: Path) -> None:
    example().write(tmp_path)
    before = files_of(tmp_path)
    assert {path.stem for path in before} == {"cameras", "images", "points3D"}
    (tmp_path / "notes.txt").write_text("x")
    assert files_of(tmp_path) == before


FAR = np.array([476_000.0, 5_430_000.0, 200.0])
NO_CENTRES = {"colmap", "opensfm", "bundler"}  # they store translations
NUMBER = re.compile(r"(?<![0-9])-?[0-9]\.[0-9]{7,}(?:e-[0-9]+)?")


@pytest.mark.parametrize("decimals", [6, 10])
@pytest.mark.parametrize("name", sorted({*MADE, "polycam"} - NO_CENTRES))
def test_rounded_rotations_do_not_move_cameras_far_from_the_origin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, decimals: int
) -> None:
    poses = POSES.copy()
    poses[:, :3, 3] -= poses[:, :3, :3] @ FAR
    for module in (drawn, drawn_surveys):
        monkeypatch.setattr(module, "POSES", poses)
    monkeypatch.setattr(drawn, "POINTS", POINTS + FAR)
    path = (MADE | {"polycam": polycam})[name](tmp_path)
    for file in tmp_path.rglob("*"):
        if file.suffix in (".json", ".xml", ".csv", ".xmp"):
            text = file.read_text(encoding="utf-8")
            rounded = NUMBER.sub(lambda found: f"{float(found[0]):.{decimals}f}", text)
            file.write_text(rounded, encoding="utf-8")
        elif file.suffix == ".npy":
            np.save(file, np.load(file).round(decimals))
    views = sorted(read_cameras(path).views, key=lambda view: view.name)
    centres = np.array([view.camera.centre for view in views])
    np.testing.assert_allclose(centres, EYES + FAR, rtol=0, atol=1e-6)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("blender", "transforms_test.json"),
        ("llff", "poses_bounds.npy"),
        ("opensfm", "reconstruction.json"),
        ("inria", "cameras.json"),
        ("bundler", "bundle.out"),
        ("metashape", "cameras.xml"),
        ("realityscan", "cameras.csv"),
        ("arkit", "frame_00006.json"),
        ("realityscan_xmp", "p_2.xmp"),
        ("opf", "project.opf"),
        ("opf", "calibrated-cameras.json"),
    ],
)
def test_half_a_file_is_refused_in_words(tmp_path: Path, name: str, file: str) -> None:
    path = MADE[name](tmp_path)
    _cut(tmp_path / file)
    with pytest.raises(SplatError) as caught:
        read_cameras(path)
    assert caught.value.code == "cameras-unreadable"
    assert file in caught.value.given


def test_bundlers_pictures_outside_its_folder_are_not_opened(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    path = MADE["bundler"](tmp_path / "a" / "b")
    names = (path.parent / "list.txt").read_text().splitlines()
    (path.parent / names[1]).rename(tmp_path / "other.png")
    names[1] = "../../other.png"
    (path.parent / "list.txt").write_text("\n".join(names))
    with pytest.raises(SplatError, match="which is outside"):
        read_cameras(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-le", "utf-16-be"])
def test_entities_of_xml_are_refused_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    path = MADE["metashape"](tmp_path)
    text = path.read_text(encoding="utf-8").partition("?>")
    body = text[2] or text[0]
    written = f"<?xml version='1.0'?><!DOCTYPE d [<!ENTITY a 'b'>]>{body.lstrip()}"
    path.write_bytes(written.encode(encoding))
    with pytest.raises(SplatError, match="entities"):
        read_cameras(path)


def test_bundlers_list_of_pictures_is_among_its_files(tmp_path: Path) -> None:
    """Another order gives the pictures other cameras."""
    files = files_of(MADE["bundler"](tmp_path))
    assert {path.name for path in files} == {"bundle.out", "list.txt"}


def test_bundlers_missing_list_may_be_written(tmp_path: Path) -> None:
    path = MADE["bundler"](tmp_path)
    (tmp_path / "list.txt").unlink()
    with pytest.raises(SplatError, match="no list of pictures") as caught:
        read_cameras(path)
    assert f"Write {tmp_path / 'list.txt'}" in caught.value.hint


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("IMG 1.jpg", "IMG 1.jpg"),
        ("IMG 1.jpg", "IMG 1.jpg 0 532.1\r"),
        ("IMG_1.jpg", "IMG_1.jpg 0 532.1"),
        ("IMG_1.jpg", " IMG_1.jpg\t0 5.321e+02 "),
        ("day 2/IMG 1.jpg", "day 2/IMG 1.jpg"),
    ],
)
def test_names_in_bundlers_list_may_hold_spaces(tmp_path: Path, name: str, line: str) -> None:
    path = MADE["bundler"](tmp_path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / "p_1.png").rename(tmp_path / name)
    names = (tmp_path / "list.txt").read_text()
    (tmp_path / "list.txt").write_text(names.replace("p_1.png", line))
    assert [view.name for view in read_cameras(path).views] == ["p_0.png", name, *NAMES[2:]]


def test_colmaps_names_of_bundlers_files_are_found(tmp_path: Path) -> None:
    path = MADE["bundler"](tmp_path).rename(tmp_path / "model.bundle.out")
    (tmp_path / "list.txt").rename(tmp_path / "model.list.txt")
    (tmp_path / "list.txt").write_text("another.png\n")
    assert len(read_cameras(path).views) == len(POSES)
    assert {file.name for file in files_of(path)} == {"model.bundle.out", "model.list.txt"}


@pytest.mark.parametrize("name", ["cameras.json", "cameras.xml", "cameras.csv", "cameras.out"])
def test_gigabytes_are_refused_before_they_are_read(tmp_path: Path, name: str) -> None:
    with (tmp_path / name).open("wb") as file:
        file.write(b'{"frames": [')
        file.truncate(4 << 30)  # takes no room on a disk
    with pytest.raises(SplatError, match=r"4\.3 GB") as caught:
        read_cameras(tmp_path / name)
    assert caught.value.code == "cameras-unreadable"


def test_the_size_of_a_heic_is_read_before_any_photograph(tmp_path: Path) -> None:
    """By a process that has not set up the reader of photographs."""
    code = (
        "import sys; from pathlib import Path; from stages.cameras.camera_file import stored_size; "
        "print(stored_size(Path(sys.argv[1])))"
    )
    pillow_heif.from_pillow(Image.new("RGB", (64, 48))).save(tmp_path / "a.heic")
    command = [sys.executable, "-c", code, str(tmp_path / "a.heic")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "(64, 48)"
