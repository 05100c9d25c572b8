"""Captures in turned worlds are the same captures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.scene import Splats
from stages.scene.pictures import load_image
from tests.small_scene import SmallScene, small_scene
from tests.turned_worlds import WORLDS, in_world, seeds_in_world


@pytest.fixture
def small(tmp_path: Path) -> SmallScene:
    return small_scene(tmp_path, views=3)


@pytest.mark.parametrize("name", WORLDS)
def test_a_pixel_shows_the_same_point_in_every_world(
    name: str, small: SmallScene, tmp_path: Path
) -> None:
    world, seeds = WORLDS[name], small.splats
    there = in_world(small.reconstruction, world, tmp_path / "there")
    moved = seeds_in_world(seeds, world, there)
    for view, turned in zip(small.reconstruction.views, there.views, strict=True):
        pixels, z = view.camera.project(seeds.means)
        found, depths = turned.camera.project(moved.means)
        if world.mirrored:
            found[:, 0] = view.camera.width - found[:, 0]
        np.testing.assert_allclose(depths, world.scale * z, rtol=1e-5)
        np.testing.assert_allclose(found, pixels, atol=1e-3)
        rotation = turned.camera.world_to_camera[:3, :3]
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        size = view.camera.width, view.camera.height
        shown, wanted = (
            load_image(made.folder / view.image, *size) for made in (there, small.reconstruction)
        )
        assert np.array_equal(shown[:, ::-1] if world.mirrored else shown, wanted)


def test_seeds_grow_with_the_unit_and_keep_their_colours(small: SmallScene) -> None:
    seeds: Splats = small.splats
    longer = seeds_in_world(seeds, WORLDS["in millimetres"], small.reconstruction)
    np.testing.assert_allclose(np.exp(longer.log_scales - seeds.log_scales), 1000.0, rtol=1e-4)
    assert np.array_equal(longer.sh, seeds.sh)
