"""Rows 22, 23 and 27: where splats come to lie on the picture, whatever the camera."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.base.stage import Report
from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.scene import Camera, look_at, scene_extent
from stages.train import build
from stages.train.loop import train as train_all
from stages.train.settings import TrainSettings
from tests.extremes.measured import Measured, broken, difference, worst
from tests.extremes.oracles import centre_in_picture, inside_clamp, means2d, textbook_picture
from tests.scenes import camera, cloud, splats, textbook_alpha
from tests.small_scene import small_scene
from tests.tolerances import FLOAT32_IMAGE, FLOAT32_OUTPUT, FLOAT32_SHIFT, PLACE_PX

BACKGROUND = (0.2, 0.5, 0.9)


def tile_edge(backend):
    view, found, drawn = camera(64, 48), [], True
    for at in ((16.0, 16.0), (32.0, 8.0), (0.0, 0.0), (64.0, 48.0), (15.5, 15.5)):
        x, y = (at[0] - 32) / 60 * 2, (at[1] - 24) / 60 * 2
        scene = splats((x, y, 2), scales=(0.2, 0.05, 0.1), opacities=0.8, rgb=(1, 1, 1))
        alpha = render(scene, view, RasterSettings(), backend).alpha
        found.append(difference(alpha, textbook_alpha(scene, view)))
        drawn &= bool(alpha.any())
    return [
        Measured(22, "alpha", worst(found), FLOAT32_SHIFT),
        Measured(22, "not drawn at all", int(not drawn), 0),
    ]


def odd_sizes(backend):
    errors = [_picture_error(backend, camera(*size)) for size in ((1, 1), (17, 1), (47, 33))]
    return [Measured(23, "image", worst(errors), _bound(backend))]


def _bound(backend):
    return FLOAT32_OUTPUT if backend == "reference" else FLOAT32_IMAGE


def _picture_error(backend, view, scene=None):
    """Against extended precision where nothing is frozen, and for kernels against the reference
    everywhere."""
    scene = scene or cloud(120, view.width, view.height, degree=0)
    settings = RasterSettings(background=BACKGROUND)
    plain = scene.take(inside_clamp(scene, view))
    found = render(plain, view, settings, backend).image
    errors = [difference(found, textbook_picture(plain, view, BACKGROUND))]
    if backend != "reference":
        wanted = render(scene, view, settings, "reference").image
        errors.append(difference(render(scene, view, settings, backend).image, wanted))
    return worst(errors)


def odd_cameras(backend):
    turned = [
        camera(matrix=look_at(np.zeros(3), np.array([np.sin(a), 0.1, np.cos(a)])))
        for a in (-0.3, 0.0, 0.3)
    ]
    wide = [_wide()]
    aside = [camera(cx=-300.0, cy=-170.0), camera(cx=64 + 500.0, cy=20.0)]
    found = []
    for what, views in (
        ("170 degrees", wide),
        ("principal point off the image", aside),
        ("coincident cameras", turned),
    ):
        places = worst(_place_error(backend, view) for view in views)
        pictures = worst(_picture_error(backend, view, _cloud_before(view)) for view in views)
        found.append(Measured(27, f"place of splats, {what}, px", places, PLACE_PX))
        found.append(Measured(27, f"image, {what}", pictures, _bound(backend)))
    bad = _coincident_training(backend)
    return [*found, Measured(27, "values not finite after training on coincident cameras", bad, 0)]


def _wide(width=64, height=48):
    focal = width / 2 / np.tan(np.radians(85))
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def _cloud_before(view, n=120, size_px=2.0):
    """Splats all over the picture, about as large in it whatever the camera."""
    r = np.random.default_rng(5)
    z = r.uniform(2, 6, n)
    px = r.uniform((4, 4), (view.width - 4, view.height - 4), (n, 2))
    slopes = (px - (view.cx, view.cy)) / (view.fx, view.fy)
    at = np.concatenate([slopes, np.ones((n, 1))], 1) * z[:, None]
    pose = view.world_to_camera
    means = (at - pose[:3, 3]) @ pose[:3, :3]
    # seen aslant, a splat's extent in depth adds to its length on the picture
    stretch = np.sqrt(1 + (slopes**2).max(1))
    scales = (size_px * z / view.fx / stretch)[:, None] * np.exp(r.normal(0, 0.1, (n, 3)))
    scene = splats(
        means, scales=scales, opacities=r.uniform(0.3, 0.9, n), rgb=r.uniform(0, 1, (n, 3))
    )
    return replace(scene, quaternions=r.normal(size=(n, 4)).astype(np.float32))


def _place_error(backend, view):
    """Each splat is drawn alone and looked for in its picture."""
    scene = _cloud_before(view, n=24)
    found = []
    for row, wanted in enumerate(means2d(scene, view)):
        picture = render(scene.take(np.array([row])), view, RasterSettings(), backend).alpha
        found.append(difference(centre_in_picture(picture), wanted))
    return worst(found)


def _coincident_training(backend):
    """Cameras that differ only in where they look have no extent; training stays finite."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = small_scene(folder, views=3, n=40)
        first = scene.reconstruction.views[0].camera
        targets = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0, 0.3]])
        cameras = [
            replace(first, world_to_camera=look_at(first.centre, target)) for target in targets
        ]
        views = tuple(
            replace(view, camera=at)
            for view, at in zip(scene.reconstruction.views, cameras, strict=True)
        )
        reconstruction = replace(scene.reconstruction, views=views)
        steps = 4 if backend == "reference" else 30
        settings = TrainSettings(
            steps=steps, train_side=36, sh_degree=1, max_splats=100, backend=backend
        )
        trainer = build.make_trainer(reconstruction, scene.splats, settings, folder, Report())
        model = train_all(trainer, scene.splats)
        degenerate = int(not 0 < scene_extent(views) < np.inf)
        removed = 1 - len(model) / len(scene.splats)  # sparsification takes a third
        return degenerate + int(not 0 <= removed < 0.5) + broken(*model.arrays)
