"""Scale and orientation that camera files state for their world."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.base.errors import SplatError
from stages.cameras.camera_file import NO_GEOREFERENCE, Georeference
from stages.cameras.camera_formats import read_cameras
from stages.scene.place import GEOGRAPHIC, geocentric
from tests.cameras.drawn import CHUNK, EYES, POSES, metashape, opensfm
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


COMPONENTS = (
    (TURN, np.array([4_000_000.0, 300_000.0, 4_950_000.0]), 0.5),
    (
        Rotation.from_rotvec([0.3, 1.2, -0.4]).as_matrix(),
        np.array([4_000_004.0, 299_997, 4.95e6]),
        3,
    ),
)


def in_components(folder: Path, of_camera: list[int], placed: int = 2) -> Path:
    """Metashape's cameras, each in the coordinates of its component: COMPONENTS[i] takes these to
    the reference. placed: components whose transform the file holds. The first takes cameras at
    EYES there."""
    path = metashape(folder)
    text = path.read_text().replace(CHUNK, "")
    turn, shift, scale = COMPONENTS[0]
    for number, (pose, index) in enumerate(zip(POSES, of_camera, strict=True)):
        to_world = np.linalg.inv(pose)
        own_turn, own_shift, own_scale = COMPONENTS[index]
        there = scale * turn @ to_world[:3, 3] + shift
        to_own = np.eye(4)
        to_own[:3, :3] = own_turn.T @ turn @ to_world[:3, :3]
        to_own[:3, 3] = own_turn.T @ (there - own_shift) / own_scale
        words = [" ".join(map(repr, map(float, m.ravel()))) for m in (to_world, to_own)]
        label = f'label="p_{number}"'
        assert words[0] in text
        text = text.replace(words[0], words[1]).replace(label, f'{label} component_id="{index}"')
    inside = "".join(
        f'<component id="{index}"><transform><rotation>{" ".join(map(str, turn.ravel()))}'
        f"</rotation><translation>{' '.join(map(str, shift))}</translation><scale>{scale}</scale>"
        "</transform></component>"
        for index, (turn, shift, scale) in enumerate(COMPONENTS[:placed])
    )
    path.write_text(text.replace("</chunk>", f"<components>{inside}</components></chunk>"))
    return path


@pytest.mark.parametrize("of_camera", [[0, 0, 0, 1], [0, 1, 0, 1], [1, 0, 0, 0]])
def test_metashapes_components_are_in_one_world(tmp_path: Path, of_camera: list[int]) -> None:
    """That of the component with most cameras."""
    found = read_cameras(in_components(tmp_path, of_camera))
    moved = np.array([view.camera.world_to_camera for view in found.views])
    # Coordinates of the earth are rounded to 1e-9 m.
    np.testing.assert_allclose(moved, POSES, atol=1e-8)
    assert found.georeference.metres_per_unit == 0.5


def test_the_component_with_most_cameras_is_metashapes_world(tmp_path: Path) -> None:
    found = read_cameras(in_components(tmp_path, [0, 1, 1, 1]))
    assert found.georeference.metres_per_unit == 3
    centres = np.array([view.camera.centre for view in found.views])
    distances = np.linalg.norm(centres[:, None] - centres, axis=2) * 3
    wanted = np.linalg.norm(EYES[:, None] - EYES, axis=2) * 0.5
    np.testing.assert_allclose(distances, wanted, atol=1e-8)
    place = found.georeference.place
    assert place is not None
    np.testing.assert_allclose(geocentric(place.offset), COMPONENTS[1][1], atol=1e-5)


def test_the_transform_of_another_component_is_not_that_of_the_cameras(tmp_path: Path) -> None:
    found = read_cameras(in_components(tmp_path, [0, 0, 0, 0]))
    assert found.georeference.metres_per_unit == 0.5
    found = read_cameras(in_components(tmp_path / "other", [1, 1, 1, 1], placed=1))
    assert found.georeference.metres_per_unit == 0.0


@pytest.mark.parametrize("placed", [0, 1])
def test_components_that_are_not_placed_are_refused(tmp_path: Path, placed: int) -> None:
    with pytest.raises(SplatError, match="belong to 2 components") as caught:
        read_cameras(in_components(tmp_path, [0, 0, 1, 1], placed))
    assert caught.value.code == "cameras-unreadable"
    assert "Align or merge the components" in caught.value.hint


def test_two_components_of_identity_transforms_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "COMPONENTS", ((np.eye(3), np.zeros(3), 1.0),) * 2)
    with pytest.raises(SplatError, match="belong to 2 components"):
        read_cameras(in_components(tmp_path, [0, 0, 1, 1]))


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


FEET = 'LENGTHUNIT["US survey foot",0.304800609601219]'
LONG_ISLAND = (
    'PROJCRS["NAD83 / New York Long Island (ftUS)",BASEGEOGCRS["NAD83",DATUM["D",'
    'ELLIPSOID["GRS 1980",6378137,298.257222101,LENGTHUNIT["metre",1]]],ID["EPSG",4269]],'
    'CONVERSION["zone",METHOD["Lambert Conic Conformal (2SP)",ID["EPSG",9802]],'
    f'PARAMETER["Easting at false origin",984250,{FEET},ID["EPSG",8826]]],CS[Cartesian,2],'
    f'AXIS["(X)",east,ORDER[1],{FEET}],\n  AXIS["(Y)",north,ORDER[2],{FEET}],ID["EPSG",2263]]'
)
EGM96 = (
    'VERTCRS["EGM96 height",VDATUM["EGM96 geoid"],CS[vertical,1],AXIS["gravity-related height (H)",'
    'up,LENGTHUNIT["metre",1]],ID["EPSG",5773]]'
)
# without a code, and with a parameter in feet
GRID = LONG_ISLAND.partition("CS[")[0] + (
    'CS[Cartesian,2],AXIS["(X)",east],AXIS["(Y)",north],LENGTHUNIT["metre",1]]'
)


def framed(folder: Path, definition: str) -> Georeference:
    """Of an OPF project whose reference frame is so defined."""
    path = opf(folder)
    frame = folder / "scene-reference-frame.json"
    frame.write_text(
        json.dumps(json.loads(frame.read_text()) | {"crs": {"definition": definition}})
    )
    return read_cameras(path).georeference


@pytest.mark.parametrize(
    ("definition", "crs"),
    [
        (UTM32, "EPSG:32632"),
        (f'COMPOUNDCRS["UTM zone 32N, ""EGM96"" [m]",{UTM32},{EGM96}]', "EPSG:32632"),
        ("EPSG:32632", "EPSG:32632"),
        ("EPSG:32632+5773", "EPSG:32632"),
        ("EPSG:32632+EPSG:5773", "EPSG:32632"),
        (GRID, None),
        ('ENGCRS["Site",EDATUM["Corner"],CS[Cartesian,3],LENGTHUNIT["metre",1.0]]', None),
    ],
)
@pytest.mark.parametrize("pyproj", [True, False])
def test_opfs_reference_frame_is_the_place_of_its_world(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, definition: str, crs: str | None, pyproj: bool
) -> None:
    if not pyproj:
        monkeypatch.setitem(sys.modules, "pyproj", None)
    ground = framed(tmp_path, definition)
    assert ground.metres_per_unit == 1.0
    assert (ground.place.crs if ground.place else None) == crs
    if ground.place:
        np.testing.assert_array_equal(ground.place.offset, np.negative(SHIFT))


@pytest.mark.parametrize(
    "definition",
    [
        LONG_ISLAND,
        f'COMPOUNDCRS["c",{LONG_ISLAND},{EGM96}]',
        f'ENGCRS["Site",EDATUM["Corner"],CS[Cartesian,3],AXIS["x",east],{FEET}]',
    ],
)
def test_opfs_unit_is_that_of_its_axes(tmp_path: Path, definition: str) -> None:
    """A place would be taken to be in metres."""
    ground = framed(tmp_path, definition)
    assert (ground.metres_per_unit, ground.place) == (0.304800609601219, None)


@pytest.mark.parametrize("code", ["EPSG:2263", "EPSG:2263+6360"])
def test_opfs_code_of_a_system_in_feet_is_not_in_metres(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str
) -> None:
    if importlib.util.find_spec("pyproj"):
        ground = framed(tmp_path / "known", code)
        assert ground.metres_per_unit == pytest.approx(0.304800609601219, rel=1e-12)
        assert ground.place is None
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert framed(tmp_path, code) == NO_GEOREFERENCE


@pytest.mark.parametrize(
    "definition",
    [
        "EPSG:4326+5773",
        "EPSG:999999",
        "ESRI:102001",
        "EPSG:",
        'GEOGCRS["WGS 84",CS[ellipsoidal,3],AXIS["h",up,LENGTHUNIT["metre",1]],ID["EPSG",4979]]',
        'PROJCRS["p",AXIS["x",east,LENGTHUNIT["metre",1]],AXIS["y",north,LENGTHUNIT["foot",0.3]]]',
        'PROJCRS["p",AXIS["x",east,LENGTHUNIT["metre",0]]]',
        'PROJCRS["p",AXIS["x",east,LENGTHUNIT["metre",1e999]]]',
        'PROJCRS["truncated',
    ],
)
def test_opfs_frame_that_states_no_length_is_arbitrary(tmp_path: Path, definition: str) -> None:
    assert framed(tmp_path, definition) == NO_GEOREFERENCE


def test_opf_with_axes_of_different_units_is_arbitrary(tmp_path: Path) -> None:
    path = opf(tmp_path)
    frame = tmp_path / "scene-reference-frame.json"
    frame.write_text(frame.read_text().replace("[1, 1, 1]", "[0.3048, 0.3048, 1]"))
    assert read_cameras(path).georeference.metres_per_unit == 0.0
