"""Files that can hold a camera say where a viewer begins, and we begin there."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stages import formats
from stages.base.errors import SplatError
from stages.editing.operations import join
from stages.page.cameras import page_cameras
from stages.raster.similarity import Similarity, rotation_about
from stages.scene import Camera, Splats, View, load_splats, look_at, save_splats
from stages.scene.framing import first_camera
from stages.viewer.render_cameras import camera_of_view
from tests.formats.files import edited_glb
from tests.formats.truth import many_splats

HOLDING = ["glb", "gltf", "quantised.glb", "usda", "usdc", "usdz", "html"]
EYE, TARGET = np.array([3.0, -2.0, -7.0]), np.array([0.5, 0.25, 1.0])
TILTED = look_at(EYE, TARGET, np.array([0.3, -1.0, 0.1]))
PORTRAIT = Camera(600, 900, 800.0, 820.0, 300.0, 450.0, TILTED)
LATER = replace(PORTRAIT, world_to_camera=look_at(-EYE, TARGET))
VIEWS = (View("b.jpg", "", LATER), View("a.jpg", "", PORTRAIT))


def written(folder: Path, suffix: str, splats: Splats | None = None) -> Path:
    path = folder / f"scene.{suffix}"
    formats.write(path, many_splats(50) if splats is None else splats, views=VIEWS)
    return path


def seen(camera: Camera | None, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """[N, 2] where points lie in the picture, from 0 to 1."""
    assert camera is not None
    return camera.project(points.astype(np.float64))[0] / (camera.width, camera.height)


@pytest.mark.parametrize("suffix", HOLDING)
def test_a_file_is_looked_at_from_its_first_camera(tmp_path: Path, suffix: str) -> None:
    back = formats.read(written(tmp_path, suffix))
    wanted = seen(PORTRAIT, back.means)
    assert seen(back.first_camera, back.means) == pytest.approx(wanted, abs=1e-5)
    assert camera_of_view(back, (), None) is back.first_camera
    assert page_cameras((), back)[0].camera is back.first_camera


@pytest.mark.parametrize("suffix", ["ply", "sog", "spz"])
def test_other_files_are_framed(tmp_path: Path, suffix: str) -> None:
    back = formats.read(written(tmp_path, suffix))
    assert back.first_camera is None
    assert first_camera(back).forward @ first_camera(many_splats(50)).forward > 0.9


@pytest.mark.parametrize("suffix", HOLDING)
def test_a_camera_goes_from_file_to_file_and_follows_edits(tmp_path: Path, suffix: str) -> None:
    first = formats.read(written(tmp_path, "glb"))
    formats.write(tmp_path / f"next.{suffix}", first)
    splats = formats.read(tmp_path / f"next.{suffix}")
    turn = Similarity(2.5, rotation_about(np.array([1.0, 2.0, 0.5]), 77), np.array([4e6, -5.0, 6]))
    moved = turn.apply_to_splats(splats)
    assert moved.origin.any()
    both = join(moved, replace(many_splats(3), origin=moved.origin))
    wanted = seen(PORTRAIT, splats.means)
    assert seen(both.first_camera, moved.means) == pytest.approx(wanted, abs=1e-4)


def test_stored_splats_keep_their_camera(tmp_path: Path) -> None:
    splats = replace(many_splats(5), first_camera=PORTRAIT)
    kept = load_splats(save_splats(tmp_path / "a.bin", splats)).first_camera
    assert kept is not None
    assert repr(kept) == repr(PORTRAIT)


@pytest.mark.parametrize("suffix", ["glb", "gltf", "quantised.glb"])
def test_gltf_has_a_camera_as_its_specification_defines_it(tmp_path: Path, suffix: str) -> None:
    import pygltflib

    path = written(tmp_path, suffix)
    document = pygltflib.GLTF2().load(str(path))
    assert document is not None
    (node,) = [node for node in document.nodes if node.camera is not None]
    assert document.nodes.index(node) in document.scenes[document.scene].nodes
    lens = document.cameras[node.camera].perspective
    # in the file's axes: y up, and a camera that looks along its -z
    x, y, z, w = node.rotation
    points = formats.read(path).means * (1, -1, -1) - np.array(node.translation)
    local = points @ np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    tangent = math.tan(lens.yfov / 2) * np.array([lens.aspectRatio, 1])
    ndc = local[:, :2] / -local[:, 2:] / tangent
    wanted = seen(PORTRAIT, formats.read(path).means)
    assert (ndc * (1, -1) + 1) / 2 == pytest.approx(wanted, abs=1e-5)
    assert lens.znear > 0


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usdz"])
def test_usd_has_a_camera_of_its_schema(tmp_path: Path, suffix: str) -> None:
    from pxr import Gf, Usd, UsdGeom

    path = written(tmp_path, suffix)
    stage = Usd.Stage.Open(str(path))
    (prim,) = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
    both = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    points = formats.read(path).means * (1, -1, -1)
    ndc = [both.Transform(Gf.Vec3d(*map(float, point))) for point in points]
    wanted = seen(PORTRAIT, formats.read(path).means)
    assert (np.array(ndc)[:, :2] * (1, -1) + 1) / 2 == pytest.approx(wanted, abs=1e-5)
    near, far = UsdGeom.Camera(prim).GetClippingRangeAttr().Get()
    assert 0 < near < far


def test_a_camera_under_scaled_and_turned_nodes_of_another_program(tmp_path: Path) -> None:
    path = written(tmp_path, "glb")

    def under_a_parent(document: dict[str, Any]) -> None:
        for node in document["nodes"]:
            if "camera" in node:
                node["translation"] = [v / 2 for v in node["translation"]]
        document["nodes"].append({"scale": [2, 2, 2], "children": [1], "name": "rig"})
        document["scenes"][0]["nodes"] = [0, 2]

    before = formats.read(path)
    edited_glb(path, under_a_parent)
    back = formats.read(path)
    wanted = seen(PORTRAIT, before.means)
    assert seen(back.first_camera, back.means) == pytest.approx(wanted, abs=1e-5)


def _orthographic(document: dict[str, Any]) -> None:
    lens = {"xmag": 1, "ymag": 1, "znear": 0.1, "zfar": 10}
    document["cameras"] = [{"type": "orthographic", "orthographic": lens}]


def _no_angle(document: dict[str, Any]) -> None:
    document["cameras"][0]["perspective"]["yfov"] = 0


def _flat(document: dict[str, Any]) -> None:
    document["nodes"][1]["scale"] = [1, 1, 0]


def _no_number(document: dict[str, Any]) -> None:
    document["cameras"][0]["perspective"]["yfov"] = math.nan


@pytest.mark.parametrize("change", [_orthographic, _no_angle, _flat, _no_number])
def test_a_camera_that_is_none_keeps_no_file_from_being_read(
    tmp_path: Path, change: Callable[[dict[str, Any]], None]
) -> None:
    path = written(tmp_path, "glb")
    edited_glb(path, change)
    back = formats.read(path)
    assert len(back) == 50
    assert back.first_camera is None


def test_splats_in_a_turned_node_are_refused_still(tmp_path: Path) -> None:
    path = written(tmp_path, "glb")
    half = math.sqrt(0.5)
    edited_glb(path, lambda document: document["nodes"][0].update(rotation=[0, half, 0, half]))
    with pytest.raises(SplatError, match="rotated, mirrored or stretched"):
        formats.read(path)


def test_a_page_with_a_wrong_camera_is_unreadable(tmp_path: Path) -> None:
    path = written(tmp_path, "html")
    text = path.read_text()
    start = text.index('"shots": [')
    shots, end = json.JSONDecoder().raw_decode(text, start + len('"shots": '))
    shots[0]["width"] = -1
    path.write_text(text[: start + len('"shots": ')] + json.dumps(shots) + text[end:])
    with pytest.raises(SplatError, match="camera"):
        formats.read(path)
