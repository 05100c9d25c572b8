"""Scale and orientation that camera files state for their world."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.cameras.camera_file import Georeference
from stages.cameras.camera_formats import read_cameras
from stages.scene.place import GEOGRAPHIC
from tests.cameras.drawn import CHUNK, EYES, metashape, opensfm
from tests.cameras.drawn_surveys import MADE, SHIFT, UTM32, arkit, opf, polycam

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
LOCAL = CHUNK[CHUNK.index("LOCAL_CS") : CHUNK.index("</reference>")]


def transformed(
    folder: Path, turn: np.ndarray, shift: tuple[float, ...], scale: float, reference: str = ""
) -> Georeference:
    """Of Metashape's cameras, the chunk so transformed."""
    path = metashape(folder)
    words = [" ".join(map(repr, map(float, np.ravel(v)))) for v in (turn, shift)]
    said = CHUNK.replace("0 -1 0 1 0 0 0 0 1", words[0]).replace("1 2 3", words[1])
    said = said.replace(">0.5<", f">{scale}<").replace(LOCAL, reference)
    path.write_text(path.read_text().replace(CHUNK, said))
    return read_cameras(path).georeference


def test_a_geocentric_chunk_is_metric_and_has_axes(tmp_path: Path) -> None:
    """By hand: at latitude 0, longitude 90 east, up is y, east is -x, north is z."""
    ground = transformed(tmp_path, TURN, (0.0, 6_378_137.0, 0.0), 12.5)
    assert ground.metres_per_unit == 12.5
    assert ground.axes is not None
    east, north, up = np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]) @ TURN
    np.testing.assert_allclose(ground.axes, [east, north, up], atol=1e-12)


def test_a_chunk_in_local_metres_or_feet_is_metric(tmp_path: Path) -> None:
    ground = transformed(tmp_path, TURN, (1.0, 2.0, 3.0), 0.5, LOCAL)
    assert ground.metres_per_unit == 0.5
    np.testing.assert_array_equal(ground.axes, TURN)
    feet = LOCAL.replace('"metre",1', '"foot",0.3048')
    found = transformed(tmp_path / "feet", TURN, (1.0, 2.0, 3.0), 0.5, feet)
    assert found.metres_per_unit == pytest.approx(0.1524)


@pytest.mark.parametrize(
    ("shift", "scale", "reference"),
    [((0, 0, 0), 1.0, LOCAL), ((1, 2, 3), 2.0, ""), ((1, 2, 3), 2.0, 'GEOGCS["WGS 84"]')],
)
def test_a_chunk_without_a_unit_is_arbitrary(
    tmp_path: Path, shift: tuple[float, ...], scale: float, reference: str
) -> None:
    ground = transformed(tmp_path, np.eye(3), shift, scale, reference)
    assert (ground.metres_per_unit, ground.axes) == (0.0, None)


def referenced(
    folder: Path, latitude: float, gps: np.ndarray | None, dop: float = 5.0
) -> Georeference:
    """Of OpenSfM's reconstruction of cameras at EYES; gps [V, 3]: GPS position of each shot."""
    path = opensfm(folder)
    data: list[dict[str, Any]] = json.loads(path.read_text())
    part = max(data, key=lambda part: len(part["shots"]))
    part["reference_lla"] = {"latitude": latitude, "longitude": 0.0, "altitude": 0.0}
    if gps is not None:
        for shot, place in zip(part["shots"].values(), gps, strict=True):
            shot["gps_position"], shot["gps_dop"] = place.tolist(), dop
    path.write_text(json.dumps(data))
    return read_cameras(path).georeference


def test_opensfm_with_a_reference_is_in_metres_as_far_as_gps_agrees(tmp_path: Path) -> None:
    ground = referenced(tmp_path / "a", 48.1, EYES + 0.1)
    assert ground.metres_per_unit == 1.0
    np.testing.assert_array_equal(ground.axes, np.eye(3))
    assert referenced(tmp_path / "b", 48.1, None).metres_per_unit == 1.0
    assert referenced(tmp_path / "c", 0.0, EYES).metres_per_unit == 0.0
    assert referenced(tmp_path / "d", 48.1, 5 * EYES).metres_per_unit == 0.0


SAYING = {"opensfm", "metashape", "arkit", "opf"}


@pytest.mark.parametrize("name", sorted(MADE.keys() - SAYING))
def test_formats_that_do_not_say_are_arbitrary(tmp_path: Path, name: str) -> None:
    ground = read_cameras(MADE[name](tmp_path)).georeference
    assert (ground.metres_per_unit, ground.axes) == (0.0, None)


def test_a_geocentric_chunk_says_where_its_zero_point_is(tmp_path: Path) -> None:
    """By hand, as above: on the equator, 10 m above the ellipsoid."""
    place = transformed(tmp_path, TURN, (0.0, 6_378_147.0, 0.0), 12.5).place
    assert place is not None
    assert place.crs == GEOGRAPHIC
    np.testing.assert_allclose(place.offset, [0, 90, 10], atol=1e-6)
    np.testing.assert_allclose(
        place.axes, 12.5 * np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]) @ TURN, atol=1e-9
    )


def test_opensfms_reference_is_the_place_of_its_world(tmp_path: Path) -> None:
    place = referenced(tmp_path, 48.1, EYES).place
    assert place is not None
    np.testing.assert_array_equal(place.offset, [48.1, 0, 0])
    np.testing.assert_array_equal(place.axes, np.eye(3))


@pytest.mark.parametrize("read", [arkit, polycam])
def test_phones_are_in_metres_with_their_up_and_no_place(tmp_path: Path, read: Any) -> None:
    ground = read_cameras(read(tmp_path)).georeference
    assert (ground.metres_per_unit, ground.place) == (1.0, None)
    assert ground.axes is not None
    np.testing.assert_array_equal(ground.axes[2], [0, 1, 0])


@pytest.mark.parametrize(
    ("definition", "crs"),
    [
        (UTM32, "EPSG:32632"),
        ("EPSG:32632", "EPSG:32632"),
        ("EPSG:32632+5773", "EPSG:32632"),
        ('ENGCRS["Site",EDATUM["Corner"],CS[Cartesian,3],LENGTHUNIT["metre",1.0]]', None),
    ],
)
def test_opfs_reference_frame_is_the_place_of_its_world(
    tmp_path: Path, definition: str, crs: str | None
) -> None:
    path = opf(tmp_path)
    frame = tmp_path / "scene-reference-frame.json"
    frame.write_text(
        json.dumps(json.loads(frame.read_text()) | {"crs": {"definition": definition}})
    )
    ground = read_cameras(path).georeference
    assert ground.metres_per_unit == 1.0
    assert (ground.place.crs if ground.place else None) == crs
    if ground.place:
        np.testing.assert_array_equal(ground.place.offset, np.negative(SHIFT))


def test_opf_in_feet_is_arbitrary(tmp_path: Path) -> None:
    path = opf(tmp_path)
    frame = tmp_path / "scene-reference-frame.json"
    frame.write_text(frame.read_text().replace("[1, 1, 1]", "[0.3048, 0.3048, 1]"))
    assert read_cameras(path).georeference.metres_per_unit == 0.0
