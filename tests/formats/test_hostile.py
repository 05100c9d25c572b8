"""Damaged and hostile files: one clear error, quickly, in bounded memory."""

from __future__ import annotations

import json
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import formats
from stages.base.errors import Family, SplatError
from tests.formats.files import edited_glb, ply_bytes
from tests.formats.truth import many_splats, red_splat


@pytest.fixture(autouse=True)
def _little_memory() -> Iterator[None]:
    """2 GiB more than now: a reader that believes a huge count fails with MemoryError."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if os.name == "posix" else 0
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (2 << 30), hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def refused(path: Path, *words: str) -> None:
    with pytest.raises(SplatError) as caught:
        formats.read(path)
    assert caught.value.code == "splats-unreadable"
    assert str(path) in caught.value.given
    for word in words:
        assert word in caught.value.given
    assert "MemoryError" not in repr(caught.value.__cause__)


@pytest.mark.parametrize("suffix", formats.FORMATS)
def test_a_file_cut_short_anywhere_is_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    formats.write(path, many_splats(9))
    whole = path.read_bytes()
    cuts = sorted({0, 1, 3, 11, 19, 27, *range(40, len(whole) - 1, max(1, len(whole) // 25))})
    if suffix.startswith("usd"):  # each takes a process
        cuts = [cuts[0], cuts[2], cuts[len(cuts) // 2], cuts[-1]]
    elif suffix == "splat":
        cuts = [cut for cut in cuts if cut % 32]
    elif suffix == "gltf":
        cuts = [cut for cut in cuts if whole[cut:].strip()]
    for cut in cuts:
        path.write_bytes(whole[:cut])
        refused(path)


@pytest.mark.parametrize("suffix", formats.FORMATS)
def test_noise_is_refused_or_read_but_never_crashes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    formats.write(path, many_splats(6))
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    rng = np.random.default_rng(5)
    for _ in range(2 if suffix.startswith("usd") else 60):
        damaged = whole.copy()
        damaged[rng.integers(0, min(len(whole), 1500), 3)] = rng.integers(0, 256, 3)
        path.write_bytes(damaged.tobytes())
        with suppress(SplatError):
            assert np.isfinite(formats.read(path).means).all()


@pytest.mark.parametrize("suffix", formats.FORMATS)
def test_what_is_no_file_is_refused(tmp_path: Path, suffix: str) -> None:
    refused(tmp_path / f"missing.{suffix}", "no such file")
    (tmp_path / f"folder.{suffix}").mkdir()
    refused(tmp_path / f"folder.{suffix}", "not a regular file")
    os.mkfifo(tmp_path / f"pipe.{suffix}")
    refused(tmp_path / f"pipe.{suffix}", "not a regular file")


def test_an_unknown_suffix_names_the_known_ones(tmp_path: Path) -> None:
    for action in (formats.read, lambda path: formats.write(path, red_splat())):
        with pytest.raises(SplatError) as caught:
            action(tmp_path / "a.obj")
        assert caught.value.family == Family.USAGE
        assert ".glb" in caught.value.wanted


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        (b"element vertex 1", b"element vertex 999999999999", "cut short"),
        (b"element vertex 1", b"element vertex " + b"9" * 400, "declares"),
        (b"element vertex 1", b"element vertex -1", "declares"),
        (b"element vertex 1", b"element vertices 1", "no element vertex"),
        (b"property float rot_3", b"property float rot_9", "rot_3"),
        (b"property float nx", b"property float x", "twice"),
        (b"property float nx", b"property list uchar int nx", "lists"),
        (b"property float nx", b"property quad nx", "not understood"),
        (b"property float nx", b"property float f_rest_9", "10 f_rest"),
        (b"binary_little_endian", b"binary_middle_endian", "encoding"),
        (b"end_header", b"end_hedder", "does not end"),
        (b"property float nx", b"property float packed_position", "compressed"),
        (b"comment units", b"units", "not understood"),
    ],
)
def test_a_ply_header_that_lies_is_refused(
    tmp_path: Path, old: bytes, new: bytes, word: str
) -> None:
    path = tmp_path / "a.ply"
    formats.write(path, red_splat())
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    refused(path, word)


def test_an_ascii_ply_that_lies_is_refused(tmp_path: Path) -> None:
    from stages.formats.ply import property_names

    path = tmp_path / "a.ply"
    good = ply_bytes(many_splats(8), property_names(3), "ascii", "float")
    assert good.count(b"element vertex 8") == 1
    path.write_bytes(good.replace(b"element vertex 8", b"element vertex 88888888888"))
    refused(path, "cut short")
    path.write_bytes(good.replace(b"element vertex 8", b"element vertex 10"))
    refused(path)
    path.write_bytes(good[:-3000] + b"x" * 2000)
    refused(path)


@pytest.mark.parametrize("suffix", ["ply", "splat", "glb"])
def test_values_that_are_not_numbers_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    splats = red_splat()
    formats.write(path, splats)
    content = path.read_bytes()
    one = np.float32(2.0 if suffix != "glb" else -2.0).tobytes()  # y of the position
    assert one in content
    for value in (np.nan, np.inf):
        path.write_bytes(content.replace(one, np.float32(value).tobytes(), 1))
        if suffix == "glb":
            position = content.rfind(one)
            path.write_bytes(
                content[:position] + np.float32(value).tobytes() + content[position + 4 :]
            )
        refused(path, "not finite")


Edit = Callable[[dict[str, Any]], None]


def _accessor(field: str, value: Any) -> Edit:
    return lambda document: document["accessors"][0].update({field: value})


def _view(field: str, value: Any) -> Edit:
    return lambda document: document["bufferViews"][0].update({field: value})


def _document(field: str, value: Any) -> Edit:
    return lambda document: document.update({field: value})


def _primitive(field: str, value: Any) -> Edit:
    return lambda document: document["meshes"][0]["primitives"][0].update({field: value})


def _extension(field: str, value: Any) -> Edit:
    def edit(document: dict[str, Any]) -> None:
        primitive = document["meshes"][0]["primitives"][0]
        primitive["extensions"]["KHR_gaussian_splatting"][field] = value

    return edit


def _many_times(document: dict[str, Any]) -> None:
    document["nodes"] = [{"mesh": 0}] * 20_000
    document["scenes"] = [{"nodes": list(range(20_000))}]


def _deep(document: dict[str, Any]) -> None:
    document["nodes"] = [{"children": [i + 1]} for i in range(5000)] + [{"mesh": 0}]
    document["nodes"][10]["children"] = [3]


@pytest.mark.parametrize(
    "edit",
    [
        _accessor("count", 4_000_000_000),
        _accessor("count", -1),
        _accessor("count", 1.5),
        _accessor("count", True),
        _accessor("count", "9"),
        _accessor("byteOffset", 1 << 60),
        _accessor("bufferView", 99),
        _accessor("bufferView", -1),
        _accessor("componentType", 5125),
        _accessor("componentType", [1]),
        _accessor("type", "VEC4"),
        _accessor("sparse", {"count": 1}),
        _view("byteLength", 1 << 60),
        _view("byteOffset", 1 << 60),
        _view("byteStride", 0),
        _view("byteStride", 4),
        _view("byteStride", 1 << 40),
        _view("buffer", 7),
        _document("buffers", [{"byteLength": 1 << 60}]),
        _document("buffers", {"byteLength": 1}),
        _document("accessors", [None]),
        _document("nodes", [{"mesh": 0, "rotation": [0, 1, 0, 0]}]),
        _document("nodes", [{"mesh": 0, "scale": [1, 2, 1]}]),
        _document("nodes", [{"mesh": 0, "matrix": [1] * 15}]),
        _document("nodes", [{"mesh": 0, "translation": [0, 0, "x"]}]),
        _document("scenes", [{"nodes": [0, 0]}]),
        _document("asset", {"version": "1.0"}),
        _document("asset", {"version": "2.0", "extras": {"splat_origin": [1, "x"]}}),
        _document("extensionsRequired", ["KHR_draco_mesh_compression"]),
        _primitive("attributes", {}),
        _primitive("attributes", []),
        _primitive("extensions", {}),
        _extension("kernel", "cube"),
        _extension("colorSpace", "lin_rec709_display"),
        _extension("extensions", {"KHR_gaussian_splatting_compression_spz_2": {}}),
        _many_times,
        _deep,
    ],
)
def test_a_glb_that_lies_is_refused(tmp_path: Path, edit: Edit) -> None:
    path = tmp_path / "a.glb"
    formats.write(path, red_splat())
    edited_glb(path, edit)
    refused(path)


@pytest.mark.parametrize(
    "address",
    [
        "../secret.bin",
        "%2e%2e/secret.bin",
        "sub/../../secret.bin",
        "/etc/passwd",
        "file:///etc/passwd",
        "http://example.com/a.bin",
        "//example.com/a.bin",
        "..\\secret.bin",
        "C:/secret.bin",
        "C%3A/secret.bin",
        "link.bin",
        "",
        ".",
        "a%00.bin",
        "missing.bin",
        "data:application/octet-stream;base64,!!!!",
        "data:application/octet-stream,abc",
        "a" * 5000,
        7,
    ],
)
def test_a_gltf_reaches_no_file_outside_its_folder(tmp_path: Path, address: Any) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    path = folder / "a.gltf"
    formats.write(path, red_splat())
    (tmp_path / "secret.bin").write_bytes((folder / "a.bin").read_bytes())
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    document = json.loads(path.read_text())
    document["buffers"][0]["uri"] = address
    path.write_text(json.dumps(document))
    refused(path)


def test_a_gltf_may_carry_its_data_inside(tmp_path: Path) -> None:
    import base64

    path = tmp_path / "a.gltf"
    formats.write(path, red_splat())
    document = json.loads(path.read_text())
    body = base64.b64encode((tmp_path / "a.bin").read_bytes()).decode()
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + body
    path.write_text(json.dumps(document))
    (tmp_path / "a.bin").unlink()
    assert len(formats.read(path)) == 1


def test_deeply_nested_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.gltf"
    path.write_text("[" * 200_000)
    refused(path)


def test_a_usd_file_that_refers_to_others_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    formats.write(path, red_splat())
    text = path.read_text()
    other = "#usda 1.0\n(\n    subLayers = [@/etc/passwd@]\n)\n"
    path.write_text(other)
    refused(path, "other files")
    path.write_text(
        text.replace('def Xform "Scene"', 'def Xform "Scene" (references = @./b.usda@)')
    )
    refused(path, "other files")


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("float[] opacities", "float[] opacity", "opacities"),
        ("opacities = [0.75]", "opacities = [0.75, 0.5]", "2 opacities"),
        ("opacities = [0.75]", "opacities = [1.75]", "outside"),
        ("opacities = [0.75]", "opacities = [nan]", "outside"),
        ("scales = [(0.", "scales = [(-0.", "negative"),
        ("sphericalHarmonicsDegree = 1", "sphericalHarmonicsDegree = 2", "coefficients"),
        ("sphericalHarmonicsDegree = 1", "sphericalHarmonicsDegree = 1000000", "degree"),
        ("positions = [(1, ", "positions = [(inf, ", "not finite"),
        ('upAxis = "Y"', 'upAxis = "Z"', "up axis"),
        ("ParticleField3DGaussianSplat", "Points", "holds no"),
    ],
)
def test_a_usd_file_that_lies_is_refused(tmp_path: Path, old: str, new: str, word: str) -> None:
    path = tmp_path / "a.usda"
    formats.write(path, red_splat())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    refused(path, word)


@pytest.mark.parametrize("suffix", formats.FORMATS)
def test_a_folder_that_cannot_be_written_is_an_error_of_its_own(
    tmp_path: Path, suffix: str
) -> None:
    with pytest.raises(SplatError) as caught:
        formats.write(tmp_path / "missing" / f"a.{suffix}", red_splat())
    assert caught.value.family == Family.RESOURCES
    (tmp_path / f"taken.{suffix}").mkdir()
    with pytest.raises(SplatError) as caught:
        formats.write(tmp_path / f"taken.{suffix}", red_splat())
    assert caught.value.family == Family.RESOURCES
    leftovers = [p.name for p in tmp_path.iterdir() if p.name.startswith(".partial")]
    assert leftovers == []


def test_damage_that_ends_the_usd_library_ends_in_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.usdc"
    formats.write(path, many_splats(6))
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    rng = np.random.default_rng(5)
    reasons = set()
    for _ in range(4):
        damaged = whole.copy()
        damaged[rng.integers(0, len(whole), 300)] = rng.integers(0, 256, 300)
        path.write_bytes(damaged.tobytes())
        with pytest.raises(SplatError) as caught:
            formats.read(path)
        reasons.add(caught.value.given.rpartition(": ")[2])
    assert reasons
