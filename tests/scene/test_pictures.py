"""Photographs as arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.base.errors import SplatError
from stages.scene.pictures import load_image


def test_colours_arrive_as_red_green_blue(tmp_path: Path) -> None:
    path = tmp_path / "été 1.png"
    Image.new("RGB", (3, 2), (255, 51, 0)).save(path)
    image = load_image(path, 3, 2)
    assert image.shape == (2, 3, 3)
    assert image.dtype == np.float32
    np.testing.assert_allclose(image[1, 2], [1.0, 0.2, 0.0], atol=1e-7)


def test_scaling_down_averages_the_area_of_each_pixel(tmp_path: Path) -> None:
    columns = np.array([0, 100, 200, 40], np.uint8)
    Image.fromarray(np.tile(columns, (2, 1))).save(tmp_path / "grey.png")
    image = load_image(tmp_path / "grey.png", 2, 1)
    np.testing.assert_allclose(image[0, :, 1] * 255, [50, 120], atol=1e-4)


def test_a_file_that_does_not_decode_is_named(tmp_path: Path) -> None:
    for name, content in {"empty.jpg": b"", "text.jpg": b"no picture"}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SplatError) as caught:
            load_image(tmp_path / name, 4, 4)
        assert name in caught.value.given
    with pytest.raises(SplatError):
        load_image(tmp_path / "missing.jpg", 4, 4)
