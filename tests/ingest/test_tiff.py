"""A TIFF becomes the picture that tifffile reads, or is left out with the reason."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from stages.ingest.decode import PixelBudget, Unusable, decode, readers_set_up

H, W = 40, 56
_Y, _X = np.mgrid[:H, :W]
PICTURE = np.stack([_X / W, _Y / H, (_X + _Y) / (W + H)], axis=-1) * 0.8 + 0.1
KINDS = ("u1", "u2", "u4", "i1", "i2", "f2", "f4")
LAYOUTS = ("grey", "white", "rgb", "rgba", "separate", "separate with alpha")
# what tifffile writes without more libraries; OpenCV writes the others below
COMPRESSIONS = (None, "zlib", "lzma")


def samples_of(kind: str, layout: str) -> NDArray[Any]:
    """[H, W, channels], alpha opaque."""
    values = PICTURE[..., 1:2] if layout in ("grey", "white") else PICTURE
    if layout in ("rgba", "separate with alpha"):
        values = np.concatenate([values, np.ones((H, W, 1))], axis=-1)
    if kind[0] == "f":
        return values.astype(kind)
    return (values * float(np.iinfo(kind).max)).astype(kind)


def write(path: Path, kind: str, layout: str, **more: Any) -> None:
    samples = samples_of(kind, layout)
    if layout in ("grey", "white"):
        photometric = "miniswhite" if layout == "white" else "minisblack"
        tifffile.imwrite(path, samples[..., 0], photometric=photometric, **more)
        return
    if samples.shape[-1] == 4:
        more["extrasamples"] = ["unassalpha"]
    if layout.startswith("separate"):
        samples = np.ascontiguousarray(samples.transpose(2, 0, 1))
    planes = "separate" if layout.startswith("separate") else "contig"
    tifffile.imwrite(path, samples, photometric="rgb", planarconfig=planes, **more)


def read_by_tifffile(path: Path) -> NDArray[np.float64]:
    """[H, W, 3] of 0..255."""
    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        samples = page.asarray()
        negative = page.photometric == tifffile.PHOTOMETRIC.MINISWHITE
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
            samples = samples.transpose(1, 2, 0)
    values = samples.reshape(H, W, -1)[..., :3] * (255.0 / np.iinfo(samples.dtype).max)
    return np.broadcast_to(255 - values if negative else values, (H, W, 3))


def decoded(path: Path) -> NDArray[np.uint8]:
    with readers_set_up():
        return decode(path, 1000, PixelBudget(10**9)).pixels


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_tiff_becomes_its_picture_or_is_left_out(tmp_path: Path, kind: str, layout: str) -> None:
    path = tmp_path / "a.tif"
    right = 0
    for order, tile, predictor, compression in itertools.product(
        "<>", (None, (16, 16)), (False, True), COMPRESSIONS
    ):
        predicted = predictor or None
        if predictor and (compression is None or kind[0] == "f"):
            continue
        write(path, kind, layout, byteorder=order, tile=tile, predictor=predicted,
              compression=compression)  # fmt: skip
        try:
            found = decoded(path)
        except Unusable:
            continue
        right += 1
        np.testing.assert_allclose(found, read_by_tifffile(path), atol=1.01)
    every = kind == "u1" or (kind == "u2" and layout in ("rgb", "rgba"))
    assert right == 20 if every else right >= (10 if kind == "u2" else 0)
    assert right == 0 or kind in ("u1", "u2")


@pytest.mark.parametrize("kind", ["u1", "u2"])
@pytest.mark.parametrize("layout", ["grey", "rgb", "rgba"])
@pytest.mark.parametrize("compression", [5, 8, 32773, 32946])  # LZW, Deflate, PackBits, Deflate
def test_compressed_by_another_program(
    tmp_path: Path, kind: str, layout: str, compression: int
) -> None:
    samples = samples_of(kind, layout)
    codes = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    channels = samples.shape[-1]
    swapped = cv2.cvtColor(samples, codes[channels]) if channels in codes else samples
    path = tmp_path / "a.tif"
    assert cv2.imwrite(str(path), swapped, [cv2.IMWRITE_TIFF_COMPRESSION, compression])
    with tifffile.TiffFile(path) as file:
        assert file.pages.first.compression == compression
    values = samples[..., :3] * (255.0 / np.iinfo(kind).max)
    np.testing.assert_allclose(decoded(path), np.broadcast_to(values, (H, W, 3)), atol=1.01)


@pytest.mark.parametrize(
    ("kind", "layout", "more", "why"),
    [
        ("u2", "separate", {}, "channels of 16 bits are stored one after the other"),
        ("u2", "separate with alpha", {"tile": (16, 16)}, "channels of 16 bits are stored"),
        ("i2", "grey", {}, "signed numbers"),
        ("i1", "grey", {}, "signed numbers"),
        ("u4", "grey", {}, "32 bits"),
        ("f4", "grey", {}, "floating-point"),
    ],
)
def test_what_is_left_out_is_named(
    tmp_path: Path, kind: str, layout: str, more: dict[str, Any], why: str
) -> None:
    write(tmp_path / "a.tif", kind, layout, **more)
    with pytest.raises(Unusable, match=why) as refused:
        decoded(tmp_path / "a.tif")
    assert "8 or 16 bits" in refused.value.hint


def test_a_predictor_that_decoders_would_pass_over_is_named(tmp_path: Path) -> None:
    write(tmp_path / "a.tif", "u2", "grey", compression="zlib", predictor=True)
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
        file.pages.first.tags["Compression"].overwrite(32773)  # PackBits
    with pytest.raises(Unusable, match="a predictor"):
        decoded(tmp_path / "a.tif")


def test_grey_of_twelve_bits_is_left_out(tmp_path: Path) -> None:
    """`tifffile` packs them with another library only: three bytes hold two samples."""
    steps = (PICTURE[..., 1] * 4095).astype(np.uint32).reshape(-1, 2)
    words = steps[:, 0] << 12 | steps[:, 1]
    packed = np.stack([words >> 16, words >> 8 & 255, words & 255], axis=1).astype(np.uint8)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, packed.reshape(H, -1), photometric="minisblack", byteorder="<")
    with tifffile.TiffFile(path, mode="r+") as file:
        file.pages.first.tags["ImageWidth"].overwrite(W)
        file.pages.first.tags["BitsPerSample"].overwrite(12)
    with pytest.raises(Unusable, match="12 bits"):
        decoded(path)
