"""Files of survey programs and phones that contradict themselves or hold what is not supported."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from stages.base.errors import SplatError
from stages.cameras.camera_formats import read_cameras
from tests.cameras.drawn_surveys import arkit, polycam


def refused(path: Path) -> str:
    with pytest.raises(SplatError) as caught:
        read_cameras(path)
    assert caught.value.code == "cameras-unreadable"
    return caught.value.given


def test_odms_shots_are_refused_with_the_file_to_name_instead(tmp_path: Path) -> None:
    (tmp_path / "shots.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    with pytest.raises(SplatError) as caught:
        read_cameras(tmp_path / "shots.geojson")
    assert caught.value.code == "cameras-unknown"
    assert "opensfm/reconstruction.json" in caught.value.hint


@pytest.mark.parametrize(
    ("make", "file", "key"),
    [
        (arkit, "frame_00006.json", "cameraPoseARFrame"),
        (polycam, "keyframes/corrected_cameras/p_1.json", "t_13"),
    ],
)
def test_a_frame_that_lacks_something_is_named(
    tmp_path: Path, make: Callable[[Path], Path], file: str, key: str
) -> None:
    folder = make(tmp_path)
    data = json.loads((tmp_path / file).read_text())
    del data[key]
    (tmp_path / file).write_text(json.dumps(data))
    given = refused(folder)
    assert Path(file).name in given
    assert key in given


def test_polycams_own_cameras_are_used_where_none_are_corrected(tmp_path: Path) -> None:
    polycam(tmp_path)
    for path in (tmp_path / "keyframes" / "corrected_cameras").iterdir():
        path.unlink()
    found = read_cameras(tmp_path)
    assert found.folder.name == "images"
