"""Rows 20 and 21: captures far from their origin, and one outlier."""

from __future__ import annotations

import functools
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages import formats
from stages.base.stage import Report
from stages.formats import usd_read
from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.scene import Camera, Reconstruction, Splats, View, look_at, scene_extent
from stages.seed import stage as seed
from stages.seed.settings import SeedSettings
from stages.sfm.place.levelling import level_and_recentre
from tests.extremes.measured import Measured, difference, worst
from tests.extremes.oracles import centre_in_picture, means2d
from tests.scenes import PARAMETERS, camera, cloud, join, splats
from tests.sfm.synthetic import orbit_model, random_rotation
from tests.tolerances import FAR_FROM_ORIGIN_PX, FLOAT32_SHIFT, ROBUST_EXTENT

# 1e6 and 6.4e6 m in some direction; float32 holds none of these numbers
OFFSETS = tuple(size * np.array([0.6, -0.48, 0.64]) + (1 / 3, 1 / 7, 0.1) for size in (1e6, 6.4e6))
OUTLIER = 7e8
CLAIM_ALL = [suffix for suffix, row in formats.FORMATS.items() if not row.loses]
BARE = SeedSettings(fill=False)  # these scenes have no photographs


def world_offset(backend):
    recentred = worst(_recentred_error(backend, which) for which in range(len(OFFSETS)))
    local = worst(_local_error(backend, origin) for origin in OFFSETS)
    kept = worst(_origin_error(suffix) for suffix in CLAIM_ALL)
    return [
        Measured(20, "recentred and seeded, px", recentred, FAR_FROM_ORIGIN_PX),
        Measured(20, "splats with an origin, px", local, FAR_FROM_ORIGIN_PX),
        Measured(20, "origin after a file that can hold it, m", kept, 0),
    ]


def _recentred_error(backend, which):
    """Where seeds are drawn, against where the model's points project beside the origin."""
    model, seeds = _model(), _seeded(which)
    at_home = replace(seeds, means=model.points)
    found = []
    for view in (0, 3):
        where = _camera(_shifted(which).world_to_camera[view])
        wanted = means2d(at_home, _camera(model.world_to_camera[view]))
        found += [
            _place_error(backend, seeds, row, where, wanted[row])
            for row in range(0, len(seeds), 9)
            if 10 < wanted[row, 0] < 86 and 10 < wanted[row, 1] < 62
        ]
    return worst(found)


def _camera(pose):
    return Camera(96, 72, 75.0, 75.0, 48.0, 36.0, pose)


def _place_error(backend, scene, row, view, wanted):
    """One splat, made opaque enough to measure, drawn alone and looked for in its picture."""
    one = replace(scene.take(np.array([row])), opacity_logits=np.full(1, 2.0, np.float32))
    picture = render(one, view, RasterSettings(), backend).alpha
    return difference(centre_in_picture(picture), wanted)


@functools.cache
def _model():
    """In a frame of its own, as structure from motion happens to choose it."""
    model = orbit_model(views=6, points=80)
    turn = random_rotation(3)
    poses = model.world_to_camera.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ turn.T
    return replace(model, world_to_camera=poses, points=model.points @ turn.T)


@functools.cache
def _shifted(which):
    """The same model far away, brought back by the stage."""
    model, shift = _model(), OFFSETS[which]
    poses = model.world_to_camera.copy()
    poses[:, :3, 3] -= poses[:, :3, :3] @ shift
    return level_and_recentre(replace(model, world_to_camera=poses, points=model.points + shift))[0]


@functools.cache
def _seeded(which):
    model = _shifted(which)
    return _seeds(model.points, [_camera(pose) for pose in model.world_to_camera])


def _seeds(points, cameras) -> Splats:
    n = len(points)
    reconstruction = Reconstruction(
        folder=Path(),
        views=tuple(View(f"{i}.jpg", f"{i}.jpg", c) for i, c in enumerate(cameras)),
        points=points,
        colours=np.random.default_rng(0).integers(0, 256, (200, 3)).astype(np.uint8)[:n],
        errors_px=np.full(n, 0.5),
        tracks=np.full(n, 4, np.int32),
    )
    with tempfile.TemporaryDirectory() as folder:
        return seed.run({"sfm": reconstruction}, BARE, Path(folder), Report())


def _local_error(backend, origin):
    """Splats that know their origin, seen by a camera in the capture's coordinates."""
    scene = replace(cloud(60, size_px=2.0, spread=0.1), origin=origin)
    at_home = camera(matrix=look_at(np.array([0.3, -0.2, -0.5]), np.array([0.1, 0, 4.0])))
    pose = at_home.world_to_camera.copy()
    pose[:3, 3] -= pose[:3, :3] @ scene.origin
    local = scene.local(replace(at_home, world_to_camera=pose))
    return worst(
        _place_error(backend, scene, row, local, wanted)
        for row, wanted in enumerate(means2d(scene, at_home))
        if 8 < wanted[0] < 56 and 8 < wanted[1] < 40
    )


@functools.cache
def _origin_error(suffix):
    scene = replace(cloud(3), origin=OFFSETS[1])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{suffix}"
        formats.write(path, scene)
        # as `formats.read`, without the process that it starts for USD
        back = usd_read.parse(path) if suffix.startswith("usd") else formats.read(path)
    return difference(back.origin, scene.origin)


def one_outlier(backend):
    seeds, same_seeds = _seeds_with_outlier()
    view = camera(matrix=look_at(np.array([0.5, -0.5, -3.0]), np.zeros(3)))
    images = [render(s, view, RasterSettings(), backend).image for s in (seeds, same_seeds)]
    moved = [difference(getattr(same_seeds, n), getattr(seeds, n)) for n in PARAMETERS]
    few = worst(_extent_change(count) for count in (5, 10, 20))
    many = worst(_extent_change(count) for count in (21, 25, 100))
    return [
        Measured(21, "seeds, one point outlying", worst(moved), FLOAT32_SHIFT),
        Measured(21, "image of seeds, one point outlying", difference(*images), FLOAT32_SHIFT),
        Measured(21, "image of splats, one of them outlying", _beside(backend), FLOAT32_SHIFT),
        Measured(21, "extent, one of 5, 10, 20 cameras outlying, log2", few, ROBUST_EXTENT),
        Measured(21, "extent, one of 21, 25, 100 cameras outlying, log2", many, ROBUST_EXTENT),
    ]


@functools.cache
def _seeds_with_outlier():
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (150, 3))
    eyes = [(-1, -1, -3), (1, -1, -3), (-1, 1, -3), (1, 1, -3)]
    cameras = [
        Camera(64, 48, 50, 50, 32, 24, look_at(np.array(eye, float), np.zeros(3))) for eye in eyes
    ]
    far = np.array([[OUTLIER, -OUTLIER, OUTLIER]])
    return _seeds(points, cameras), _seeds(np.concatenate([points, far]), cameras)


def _beside(backend):
    """Change of a picture by one splat that lies far out of it, in front, beside and behind."""
    scene, view = cloud(60), camera()
    alone = render(scene, view, RasterSettings(), backend).image
    changes = []
    for place in ((OUTLIER, 0, 5), (0, -OUTLIER, OUTLIER / 10), (0, 0, -OUTLIER)):
        both = join(splats(place, scales=0.1, opacities=0.99), scene)
        changes.append(difference(render(both, view, RasterSettings(), backend).image, alone))
    return worst(changes)


def _extent_change(count):
    """By how many powers of two the scene's extent changes when one of `count` cameras strays."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = [np.array([3 * np.cos(a), -1.0, 3 * np.sin(a)]) for a in angles]
    views = [
        View(f"{i}.jpg", f"{i}.jpg", camera(matrix=look_at(eye, np.zeros(3))))
        for i, eye in enumerate(eyes)
    ]
    stray = np.eye(4)
    stray[:3, 3] = OUTLIER
    strayed = (*views[:-1], View("stray.jpg", "stray.jpg", camera(matrix=stray)))
    return abs(float(np.log2(scene_extent(strayed) / scene_extent(tuple(views)))))
