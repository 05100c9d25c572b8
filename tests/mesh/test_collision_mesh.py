"""Splats on a known surface become that surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.mesh import extract, fuse
from stages.mesh.collision_mesh import CollisionMesh, make_collision_mesh
from stages.mesh.extract import extract_surface, remove_small_components, simplify
from stages.mesh.fuse import Volume
from stages.raster.kernels.pool import Pool
from stages.scene import Reconstruction, Splats
from stages.scene.mesh import Mesh
from tests.mesh.shapes import (
    CENTRE,
    all_around,
    ball,
    joined,
    seen_from,
    sphere,
)
from tests.tolerances import MESH_VOXELS

AIR = (0.9, -0.9, 0.9), (-0.9, 0.9, 0.9)  # from the centre: in corners of the box around the sphere


@pytest.fixture(autouse=True)
def _few_voxels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuse, "VOXELS", 64**3)


def made(
    splats: Splats, reconstruction: Reconstruction, triangles: int = 100_000
) -> tuple[CollisionMesh, Report]:
    report = Report()
    return make_collision_mesh(splats, reconstruction, triangles, "auto", report), report


def test_a_sphere_seen_from_all_sides_is_that_sphere() -> None:
    found, report = made(sphere(), all_around())
    mesh, figures = found.mesh, found.figures
    away = mesh.vertices - CENTRE
    radii = np.linalg.norm(away, axis=1)
    assert np.abs(radii - 1).max() < MESH_VOXELS * figures["voxel"]
    assert figures["watertight"]
    assert figures["triangles"] == len(mesh.faces) > 1000
    assert figures["covered_share"] > 0.99
    assert report.warnings == []
    # outwards, towards the cameras, by the corners' order and by the normals
    assert ((mesh.normals() * away).sum(axis=1) > 0.8 * radii).all()
    a, b, c = (away[mesh.faces[:, i]] for i in range(3))
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(4 / 3 * np.pi, rel=0.1)
    # orange, as the splats are
    np.testing.assert_allclose(mesh.colours.mean(axis=0), [255, 128, 0], atol=4)


def test_fewer_triangles_keep_the_shape() -> None:
    found, _ = made(sphere(), all_around(), triangles=800)
    assert 700 < found.figures["triangles"] <= 800
    radii = np.linalg.norm(found.mesh.vertices - CENTRE, axis=1)
    assert np.abs(radii - 1).max() < 2 * MESH_VOXELS * found.figures["voxel"]


def ragged() -> Mesh:
    """A rough surface with holes, borders and edges of more than two faces."""
    random, shape = np.random.default_rng(0), (48, 48, 48)
    distance = np.clip(30 * gaussian_filter(random.normal(size=shape), 1.5), -4, 4)
    weight = gaussian_filter(random.normal(size=shape), 1) < 0.03
    volume = Volume(distance.astype("f4"), weight.astype("f4"), np.full(3, -1.0), 1 / 24)
    return remove_small_components(extract_surface(volume))[0]


def test_a_ragged_surface_is_simplified_as_far_as_wanted_or_possible() -> None:
    mesh = ragged()
    assert len(mesh.faces) > 8000
    for triangles in (4000, 800):
        assert 0.9 * triangles < len(simplify(mesh, triangles).faces) <= 1.05 * triangles
    assert 10 < len(simplify(mesh, 10).faces) < 800  # it ends, though it cannot get there


def test_more_triangles_than_wanted_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extract, "extract_surface", lambda volume: ragged())
    found, report = made(sphere(), all_around(3), triangles=100)
    assert found.figures["triangles"] > 105
    (warning,) = (text for code, text in report.warnings if code == "export-mesh-triangles")
    assert f"{found.figures['triangles']:,} triangles instead of 100" in warning


def test_one_camera_gives_what_it_sees_and_no_shell_behind_it() -> None:
    eye = CENTRE + np.array([0, 0, -3.5])
    found, _ = made(sphere(), seen_from([eye]))
    away = found.mesh.vertices - CENTRE
    assert np.abs(np.linalg.norm(away, axis=1) - 1).max() < 2 * MESH_VOXELS * found.figures["voxel"]
    assert (away[:, 2] < 0.1).all(), "the far side was never seen"
    assert not found.figures["watertight"]
    towards = ((eye - found.mesh.vertices) * found.mesh.normals()).sum(axis=1)
    assert (towards > 0).mean() > 0.95  # the rim is ragged


def test_small_components_are_removed_and_counted() -> None:
    above, beside = (ball(CENTRE + np.array(at), 0.08, (0, 0, 1), 40) for at in AIR)
    found, _ = made(joined(sphere(), above, beside), all_around())
    assert found.figures["removed_components"] >= 2
    assert np.linalg.norm(found.mesh.vertices - CENTRE, axis=1).max() < 1.2


@pytest.mark.slow
def test_one_thing_far_away_does_not_take_the_voxels() -> None:
    far = ball(np.array([0.5, -1.0, 500.0]), 3.0, (1, 1, 1), 100)
    near_only, _ = made(sphere(), all_around())
    both, _ = made(joined(sphere(), far), all_around())
    assert both.figures["voxel"] == pytest.approx(near_only.figures["voxel"], rel=0.3)


@pytest.mark.parametrize("what", ["no splats", "nearly transparent", "out of view", "no views"])
def test_nothing_solid_is_an_empty_mesh_with_a_warning(what: str) -> None:
    splats, views = sphere(), all_around(3)
    if what == "no splats":
        splats = splats.take(np.zeros(len(splats), bool))
    elif what == "nearly transparent":
        splats = sphere(logit=-5.5)
    elif what == "out of view":
        views = seen_from([CENTRE + np.array([0, 0, 5.0])], CENTRE + np.array([0, 0, 9.0]))
    else:
        views = replace(views, views=())
    found, report = made(splats, views)
    assert len(found.mesh.faces) == found.figures["triangles"] == 0
    assert [code for code, _ in report.warnings] == ["export-mesh-empty"]


def test_little_memory_means_larger_voxels_and_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuse, "available_mib", lambda: 1.0)
    found, report = made(sphere(), all_around())
    assert [code for code, _ in report.warnings] == ["export-mesh-coarse"]
    assert fuse.voxel_budget() * 16 <= 2**20 / 4
    radii = np.linalg.norm(found.mesh.vertices - CENTRE, axis=1)
    assert np.abs(radii - 1).max() < 2 * MESH_VOXELS * found.figures["voxel"]


def test_the_number_of_threads_does_not_change_the_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    meshes = []
    for threads in (1, 3):
        pool = Pool(threads)
        monkeypatch.setattr(fuse, "default_pool", lambda pool=pool: pool)
        meshes.append(made(sphere(), all_around(5))[0].mesh)
    for name in ("vertices", "faces", "colours"):
        np.testing.assert_array_equal(getattr(meshes[0], name), getattr(meshes[1], name))


def test_ctrl_c_stops_between_cameras() -> None:
    report = Report()
    report.stop_requested.set()
    with pytest.raises(Interrupted):
        make_collision_mesh(sphere(), all_around(3), 1000, "auto", report)
