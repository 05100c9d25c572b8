"""Which files count as photographs, in which order, under which names."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from stages.ingest.find import find
from stages.ingest.sources import natural_key, picture_names

NAMES = st.lists(
    st.builds(
        "{}{}".format,
        st.text("aAbé1_- ", min_size=1, max_size=3),
        st.sampled_from([".jpg", ".JPG", ".jpeg", ".heic", ".webp", ".png", ".tif", ".TIFF"]),
    ),
    unique=True,
    max_size=12,
)


@given(NAMES)
def test_no_two_pictures_share_a_name_even_where_case_does_not_count(names: list[str]) -> None:
    given_names = picture_names(names)
    assert set(given_names) == set(names)
    assert len({name.casefold() for name in given_names.values()}) == len(names)


@given(NAMES)
def test_names_do_not_depend_on_the_order_of_listing(names: list[str]) -> None:
    assert picture_names(names) == picture_names(names[::-1])


def test_a_name_that_can_stay_stays() -> None:
    names = picture_names(["a.heic", "a.jpg", "B/c d.JPEG", "e.tiff"])
    assert names == {
        "a.heic": "photos/a-2.jpg",
        "a.jpg": "photos/a.jpg",
        "B/c d.JPEG": "photos/B/c d.JPEG",
        "e.tiff": "photos/e.png",
    }


def test_numbers_sort_as_numbers_and_folders_stay_together() -> None:
    names = ["b10.jpg", "b9.jpg", "a 2/x.jpg", "a/2.jpg", "a/10.jpg", "B1.jpg"]
    assert sorted(names, key=natural_key) == [
        "a/2.jpg", "a/10.jpg", "a 2/x.jpg", "B1.jpg", "b9.jpg", "b10.jpg",
    ]  # fmt: skip


def test_of_a_synthetic_nerf_scene_only_what_its_camera_files_name_is_a_photograph(
    tmp_path: Path,
) -> None:
    """As the download is: maps of depth and normals beside the pictures of the test split, whose
    names lack their endings in the files."""
    pose = np.eye(4).tolist()
    for split in ("train", "test"):
        (tmp_path / split).mkdir()
        frames = []
        for i in range(3):
            for kind in ("", "_depth_0001", "_normal_0001") if split == "test" else ("",):
                Image.new("RGBA", (8, 8)).save(tmp_path / split / f"r_{i}{kind}.png")
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose})
        text = json.dumps({"camera_angle_x": 0.7, "frames": frames})
        (tmp_path / f"transforms_{split}.json").write_text(text)
    found = find(tmp_path)
    named = [f"{split}/r_{i}.png" for split in ("test", "train") for i in range(3)]
    assert [source.name for source in found.sources] == named
    assert found.others == 6 + 2
    (tmp_path / "transforms_train.json").write_text("{")  # damaged: nothing is left out
    assert len(find(tmp_path).sources) == 12


def test_links_to_folders_do_not_trap_the_search(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"x")
    try:
        (tmp_path / "loop").symlink_to(tmp_path, target_is_directory=True)
    except OSError:
        pytest.skip("links are not allowed here")
    assert [source.name for source in find(tmp_path).sources] == ["a.jpg"]


@pytest.mark.skipif(os.name != "posix", reason="only there are file names bytes")
def test_names_that_are_no_utf8_are_spelt_out(tmp_path: Path) -> None:
    for name in (b"\xff.jpg", b"\xfe.jpg"):
        try:
            Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name)).write_bytes(b"x")
        except OSError:
            pytest.skip("this disk wants UTF-8")
    assert [source.name for source in find(tmp_path).sources] == ["\\xfe.jpg", "\\xff.jpg"]


def test_3d_scanner_app_s_other_pictures_are_no_photographs(tmp_path: Path) -> None:
    """Its folder also holds a small copy of a frame and the texture of the mesh; not every frame
    has a picture. Photographs in other folders stay."""
    scan, more = tmp_path / "scan", tmp_path / "more"
    scan.mkdir()
    more.mkdir()
    for number in range(6):
        (scan / f"frame_0000{number}.json").write_text("{}")
    for name in ("frame_00000.jpg", "frame_00003.jpg", "thumb_00000.jpg", "textured_output.jpg"):
        Image.new("RGB", (8, 6)).save(scan / name)
    Image.new("RGB", (8, 6)).save(more / "a.jpg")
    (scan / "info.json").write_text("{}")
    found = find(scan)
    assert [one.name for one in found.sources] == ["frame_00000.jpg", "frame_00003.jpg"]
    assert found.beside_frames == ("textured_output.jpg",)
    assert found.others == 8  # .json files, and the small copy that every scan has
    both = [one.name for one in find(tmp_path).sources]
    assert both == ["more/a.jpg", "scan/frame_00000.jpg", "scan/frame_00003.jpg"]


def test_photographs_beside_a_frame_without_its_picture_stay(tmp_path: Path) -> None:
    Image.new("RGB", (8, 6)).save(tmp_path / "a.jpg")
    (tmp_path / "frame_00000.json").write_text("{}")
    assert [one.name for one in find(tmp_path).sources] == ["a.jpg"]
