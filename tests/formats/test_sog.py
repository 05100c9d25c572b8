"""SOG against its specification, written out again here, and packages that mean harm."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from stages import formats
from stages.base.errors import SplatError
from stages.formats import codebook
from stages.scene import morton
from tests.formats.files import angles, three_splats
from tests.formats.truth import C0, extreme_splats, many_splats


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as package:
        return {name: package.read(name) for name in package.namelist()}


def repacked(path: Path, files: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", kind) as package:
        for name, content in files.items():
            package.writestr(name, content)


def rgba(content: bytes) -> NDArray[np.int64]:
    return np.array(Image.open(io.BytesIO(content)).convert("RGBA"), np.int64)


def webp(pixels: NDArray[np.uint8]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def test_every_pixel_is_that_of_the_specification(tmp_path: Path) -> None:
    splats = three_splats()
    formats.write(tmp_path / "a.sog", splats, units="metres")
    files = members(tmp_path / "a.sog")
    meta = json.loads(files["meta.json"])
    assert (meta["version"], meta["count"], meta["shN"]["bands"]) == (2, 3, 1)
    assert meta["asset"] == {
        "generator": "splat",
        "units": "metres",
        "splat_origin": list(splats.origin),
    }
    pictures = {name: rgba(content) for name, content in files.items() if name != "meta.json"}
    assert all(files[name][12:16] == b"VP8L" for name in pictures)
    np.testing.assert_allclose(meta["means"]["maxs"], np.log([2, 3, 5]))
    steps = pictures["means_l.webp"][0, 1] + 256 * pictures["means_u.webp"][0, 1]
    wanted = 65535 * np.log([1.25, 2.5, 2]) / np.log([2, 3, 5])
    np.testing.assert_array_equal(steps[:3], np.rint(wanted))
    sizes = np.array(meta["scales"]["codebook"])[pictures["scales.webp"][0, :3, :3]]
    np.testing.assert_array_equal(sizes, splats.log_scales)
    # y = -0.7 is the largest (alpha 252 + 2): all signs change
    third = [round(255 * (0.5 + q / 2**0.5)) for q in (-0.5, -0.1, -0.5)]
    assert list(pictures["quats.webp"][0, 1]) == [*third, 254]
    colours = pictures["sh0.webp"][0, 1]
    dc = np.array(meta["sh0"]["codebook"])[colours[:3]]
    np.testing.assert_allclose(0.5 + C0 * dc, [0.5, 0.25, 1], atol=1e-6)
    assert colours[3] == 191
    label = pictures["shN_labels.webp"][0, 1]
    centroids = pictures["shN_centroids.webp"]
    assert centroids.shape[1] == 64 * 3
    entry = int(label[0] + 256 * label[1])
    kept = centroids[entry // 64, 3 * (entry % 64) : 3 * (entry % 64) + 3, :3]
    np.testing.assert_allclose(np.array(meta["shN"]["codebook"])[kept], splats.sh[1, 1:])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_come_back_as_near_as_the_format_allows(tmp_path: Path, degree: int) -> None:
    splats = many_splats(600).with_sh_degree(degree)
    formats.write(tmp_path / "a.sog", splats)
    back, wanted = formats.read(tmp_path / "a.sog"), splats.take(morton.morton_order(splats))
    np.testing.assert_array_equal(back.origin, splats.origin)
    bent, back_bent = (np.sign(m) * np.log1p(np.abs(m)) for m in (wanted.means, back.means))
    assert np.abs(back_bent - bent).max() <= 0.5 * np.ptp(bent, axis=0).max() / 65535 + 1e-6
    np.testing.assert_allclose(back.opacities, wanted.opacities, atol=0.5 / 255 + 1e-6)
    # 8 bits over sqrt 2: three errors of 1/361, and the fourth what they make of the length
    assert angles(wanted.quaternions, back.quaternions).max() < 1.2
    # 256 entries over a range: half of them lie evenly, so no gap is wider than 1/127 of it
    for name, band in (("log_scales", slice(None)), ("sh", slice(0, 1))):
        a, b = (getattr(s, name)[:, band] for s in (wanted, back))
        assert np.abs(a - b).max() <= np.ptp(a) / 127
    # fewer splats than a palette has rows: only the codebook is coarse
    np.testing.assert_allclose(back.sh, wanted.sh, atol=0.02)
    np.testing.assert_array_equal(back.sh_degrees, wanted.sh_degrees)


def test_a_palette_smaller_than_the_scene_stays_close_to_it() -> None:
    rng = np.random.default_rng(2)
    kinds = rng.normal(0, 0.3, (50, 24)).astype(np.float32)
    vectors = kinds[rng.integers(0, 50, 8000)] + rng.normal(0, 0.01, (8000, 24)).astype("f4")
    vectors[:2000] = 0
    palette, labels = codebook.vector_palette(vectors, 1024)
    assert len(palette) <= 1024
    np.testing.assert_array_equal(palette[labels[:2000]], 0)
    spread = np.sqrt(np.mean((palette[labels[2000:]] - vectors[2000:]) ** 2))
    assert spread < 0.02  # of 0.3
    again = codebook.vector_palette(vectors, 1024)
    np.testing.assert_array_equal(again[1], labels)


def test_a_palette_of_few_vectors_is_exact() -> None:
    rng = np.random.default_rng(3)
    vectors = rng.normal(size=(64, 9)).astype(np.float32)[rng.integers(0, 64, 5000)]
    vectors[:100] = 0
    palette, labels = codebook.vector_palette(vectors, 65)
    np.testing.assert_array_equal(palette[labels], vectors)
    assert len(palette) == 65
    assert len(codebook.vector_palette(vectors, 64)[0]) <= 64


def test_a_codebook_of_few_numbers_is_exact_and_of_many_is_close() -> None:
    few = np.array([3.0, -1.0, 3.0, 0.25])
    book = codebook.scalar_codebook(few)
    np.testing.assert_array_equal(book[codebook.nearest(book, few)], few)
    many = np.random.default_rng(1).normal(0, 1, 20_000)
    many[0] = 400  # one far away takes an entry, not the precision of all
    book = codebook.scalar_codebook(many)
    errors = np.abs(book[codebook.nearest(book, many)] - many)
    assert errors.max() < 0.5
    assert np.sqrt(np.mean(errors**2)) < 0.02


def test_extremes_stay_finite(tmp_path: Path) -> None:
    splats = extreme_splats(1)
    splats.sh[2, 0] = 3.4e38
    assert formats.write(tmp_path / "a.sog", splats) == 0
    back, wanted = formats.read(tmp_path / "a.sog"), splats.take(morton.morton_order(splats))
    np.testing.assert_allclose(back.log_scales, np.clip(wanted.log_scales, -20, 20), atol=1e-5)
    np.testing.assert_allclose(back.opacities, wanted.opacities, atol=1e-6)


Edit = Callable[[dict[str, Any], dict[str, bytes]], Any]


@pytest.mark.parametrize(
    ("edit", "word"),
    [
        (lambda meta, files: files.pop("scales.webp"), "does not hold"),
        (lambda meta, files: meta.update(version=1), "version 2"),
        (lambda meta, files: meta.update(count=10**9), "count"),
        (lambda meta, files: meta.update(count=60_000), "pixels"),
        (lambda meta, files: meta.update(count=True), "count"),
        (lambda meta, files: meta.update(count=-1), "count"),
        (lambda meta, files: meta["quats"].update(files=["/etc/passwd"]), "does not hold"),
        (lambda meta, files: meta["quats"].update(files=["../a.webp"]), "does not hold"),
        (lambda meta, files: meta["quats"].update(files=[7]), "does not hold"),
        (lambda meta, files: meta["quats"].update(files="quats.webp"), "names no picture"),
        (lambda meta, files: meta["quats"].update(files=["sh0.webp"]), "largest component"),
        (lambda meta, files: meta["sh0"].update(codebook=[1, 2]), "256 numbers"),
        (lambda meta, files: meta["sh0"].update(codebook=[float("nan")] * 256), "256 numbers"),
        (lambda meta, files: meta["sh0"].update(codebook=["x"] * 256), "damaged"),
        (lambda meta, files: meta["means"].update(maxs=[1e4, 1, 1]), "not finite"),
        (lambda meta, files: meta["shN"].update(bands=4), "bands"),
        (lambda meta, files: meta["shN"].update(bands=2), "pixels"),
        (lambda meta, files: meta["shN"].update(count=1), "palette"),
        (lambda meta, files: meta["asset"].update(splat_origin=[1]), "3 numbers"),
        (lambda meta, files: files.update({"sh0.webp": b"RIFF"}), "lossless WebP"),
        (lambda meta, files: files.update({"sh0.webp": files["sh0.webp"][:40]}), "damaged"),
    ],
)
def test_a_package_that_lies_is_refused(tmp_path: Path, edit: Edit, word: str) -> None:
    path = tmp_path / "a.sog"
    formats.write(path, many_splats(40))
    files = members(path)
    meta = json.loads(files["meta.json"])
    edit(meta, files)
    files["meta.json"] = json.dumps(meta).encode()
    repacked(path, files)
    with pytest.raises(SplatError, match=word) as caught:
        formats.read(path)
    assert caught.value.code == "splats-unreadable"


@pytest.mark.parametrize("name", ["meta.json", "sh0.webp"])
def test_a_zip_bomb_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.sog"
    formats.write(path, many_splats(40))
    repacked(path, {**members(path), name: bytes(200 << 20)}, zipfile.ZIP_DEFLATED)
    with pytest.raises(SplatError, match="too large"):
        formats.read(path)


def test_a_picture_bomb_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    formats.write(path, many_splats(40))
    bomb = webp(np.zeros((4000, 16000, 3), np.uint8))
    assert len(bomb) < 100_000
    repacked(path, {**members(path), "sh0.webp": bomb})
    with pytest.raises(SplatError, match="16000 x 4000 pixels"):
        formats.read(path)


def test_lossy_pictures_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    formats.write(path, many_splats(40))
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, "WEBP", quality=50)
    repacked(path, {**members(path), "means_l.webp": file.getvalue()})
    with pytest.raises(SplatError, match="lossless"):
        formats.read(path)


def test_a_package_of_another_writer_is_read(tmp_path: Path) -> None:
    """Packed, with other names, wider pictures and alpha, and something more."""
    path = tmp_path / "a.sog"
    splats = many_splats(40)
    formats.write(path, splats)
    wanted = formats.read(path)
    files = members(path)
    meta = json.loads(files["meta.json"])
    flat = rgba(files["scales.webp"]).reshape(-1, 4)[:40].astype(np.uint8)
    wide = np.zeros((3, 20, 4), np.uint8)
    wide.reshape(-1, 4)[:40] = flat
    files["in/sizes.webp"] = webp(wide)
    meta["scales"]["files"] = ["in/sizes.webp"]
    files |= {"meta.json": json.dumps(meta).encode(), "notes.txt": b"hello"}
    repacked(path, files, zipfile.ZIP_DEFLATED)
    np.testing.assert_array_equal(formats.read(path).log_scales, wanted.log_scales)
