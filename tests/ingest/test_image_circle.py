"""The image circle of a fisheye is found, and nothing else is taken for one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stages.ingest.image_circle import always_same_circle, brightest, circle_radius
from stages.scene import Camera
from tests.ingest.made_files import textured


def photographs(side: int, radius: float, count: int = 4, dx: float = 0.0) -> list[np.ndarray]:
    """Noise within a circle; noise of a dark sensor beyond it."""
    random = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    inside = np.hypot(x - side / 2 - dx, y - side / 2) < radius
    found = []
    for _ in range(count):
        dark = random.integers(0, 6, (side, side, 3))
        lit = random.integers(0, 256, (side, side, 3))
        found.append(np.where(inside[..., None], lit, dark).astype(np.uint8))
    return found


def square(side: int) -> Camera:
    return Camera(side, side, side / np.pi, side / np.pi, side / 2, side / 2, np.eye(4))


@pytest.mark.parametrize("radius", [300.0, 398.0, 500.0])
def test_a_circle_is_found_and_its_rim_left_out(radius: float) -> None:
    found = circle_radius(brightest(photographs(800, radius)), square(800))
    assert 0.97 * radius < found < radius


def test_a_circle_is_found_in_one_photograph_of_dark_things_over_the_black_of_video() -> None:
    """As lenses of 220 degrees have it: the sensor's black is 16, light scattered by the lens lies
    beyond the circle, and whoever holds the camera wears black."""
    random = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(800) + 0.5 - 400, np.arange(800) + 0.5 - 380)
    away = np.hypot(x, y)
    lit = random.integers(40, 256, (800, 800))
    lit[(y > 150) & (abs(x) < 200)] = 18
    rim = np.clip((390 - away) / 12, 0.0, 1.0)
    seen = 16 + rim * (lit - 16) + np.where((away > 400) & (x > 300) & (abs(y + 250) < 50), 20, 0)
    picture = np.repeat(seen.astype(np.uint8)[..., None], 3, axis=-1)
    camera = Camera(800, 800, 200.0, 200.0, 400.0, 380.0, np.eye(4))
    found = circle_radius(brightest([picture]), camera)
    assert 0.95 * 378 < found < 388


def test_light_that_falls_off_slowly_has_none() -> None:
    picture = photographs(600, 1000, 1)[0] // 8 + 60
    x, y = np.meshgrid(np.arange(600) - 299.5, np.arange(600) - 299.5)
    share = np.clip(1.3 - np.hypot(x, y) / 300, 0.0, 1.0)
    dimmed = (picture * share[..., None]).astype(np.uint8)
    lit = np.random.default_rng(0).random((600, 600)) < share
    assert circle_radius(brightest([dimmed * lit[..., None]]), square(600)) == np.inf


def test_a_circle_beside_the_principal_point_leaves_no_black_inside() -> None:
    found = circle_radius(brightest(photographs(800, 390, dx=6.0)), square(800))
    assert 0.95 * 384 < found <= 384


def test_pictures_that_reach_their_corners_have_none() -> None:
    assert circle_radius(brightest(photographs(600, 500)), square(600)) == np.inf


def test_a_dark_corner_is_not_a_circle() -> None:
    pictures = photographs(600, 500)
    for picture in pictures:
        picture[:200, :200] = 0
    assert circle_radius(brightest(pictures), square(600)) == np.inf


def test_black_photographs_have_none() -> None:
    assert circle_radius(brightest([np.zeros((300, 300, 3), np.uint8)]), square(300)) == np.inf


WIDTH, HEIGHT = 320, 240
X, Y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
AWAY = np.hypot(X, Y) / (HEIGHT / 2)


def lit_by(*shares: np.ndarray) -> list[np.ndarray]:
    """Pictures of a textured scene in such shares of its light, over the noise of a dark sensor."""
    random = np.random.default_rng(0)
    found = []
    for number, share in enumerate(shares):
        scene = 60 + 0.7 * textured(number, WIDTH, HEIGHT)
        dark = random.integers(0, 6, scene.shape)
        found.append(np.clip(scene * share[..., None] + dark, 0, 255).astype(np.uint8))
    return found


def disc(radius: float = 0.95, dx: float = 0.0, height: float = 1.0) -> np.ndarray:
    return (np.hypot(2 * X / HEIGHT - dx, 2 * Y / HEIGHT / height) < radius).astype(float)


LENS = {
    "circular": [disc()] * 4,
    "beside the middle": [disc(0.92, dx=0.04)] * 4,
    "cut off above and below": [disc(1.2)] * 4,
    "in most pictures": [disc()] * 3 + [disc(9.0)] * 2,
    "with somebody in black below": [np.where((Y > 60) & (abs(X) < 50), 0, disc())] * 4,
    "of little light": [0.3 * disc()] * 4,
}
NO_LENS = {
    "an ordinary lens": [disc(9.0)] * 4,
    "vignetting": [np.cos(np.arctan(1.2 * AWAY)) ** 4] * 4,
    "a torch": [1 / (1 + np.exp((AWAY - 0.9) / 0.1))] * 4,
    "a flash": [np.exp(-((AWAY / 0.6) ** 2))] * 4,
    "a dark night": [np.full(AWAY.shape, 0.02)] * 4,
    "a ball before black": [disc(0.7)] * 4,
    "a ball before black, by hand": [disc(r) for r in (0.82, 0.87, 0.92, 0.97)],
    "a plate before black": [disc(0.95, height=0.8)] * 4,
    "a box before black": [((abs(X) < 90) & (abs(Y) < 100)).astype(float)] * 4,
    "black bars above and below": [(abs(Y) < 90).astype(float)] * 4,
    "narrow bars above and below": [(abs(Y) < 100).astype(float)] * 4,
    "black bars at the sides": [(abs(X) < 120).astype(float)] * 4,
    "a circle in one picture": [disc(), *[disc(9.0)] * 3],
}


@pytest.mark.parametrize("shares", LENS.values(), ids=LENS.keys())
def test_an_unknown_lens_shows_the_same_circle_in_most_pictures(shares: list[np.ndarray]) -> None:
    assert always_same_circle(lit_by(*shares))


@pytest.mark.parametrize("shares", NO_LENS.values(), ids=NO_LENS.keys())
def test_what_is_dark_around_its_middle_is_no_lens(shares: list[np.ndarray]) -> None:
    assert not always_same_circle(lit_by(*shares))


def test_lights_of_a_night_are_no_lens() -> None:
    random = np.random.default_rng(0)
    pictures = lit_by(*[np.zeros(AWAY.shape)] * 4)
    for picture in pictures:
        for at in random.integers((0, 0), (WIDTH, HEIGHT), (25, 2)):
            middle = int(at[0]), int(at[1])
            cv2.circle(picture, middle, int(random.integers(2, 20)), (200, 220, 250), -1)
    assert not always_same_circle(pictures)


def test_no_pictures_show_none() -> None:
    assert not always_same_circle([])
