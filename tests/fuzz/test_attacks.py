"""Small files made to take long, to take much memory, or to reach what they must not."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages import formats
from stages.base.errors import SplatError
from stages.cameras import nerfstudio, realityscan
from stages.cameras.camera_file import size_of_picture
from stages.formats import streamed_sog
from stages.formats.spz_read import MAGIC
from stages.ingest.decode import PixelBudget, Unusable, decode, jpeg_fault, readers_set_up
from stages.ingest.exif import Exif
from stages.run.manifest import MANIFEST, Manifest, write_sealed
from stages.run.runfile import RUN_FILE, RunFile
from stages.scene import load_splats, save_splats
from stages.scene.draw_settings import DrawSettings
from tests.formats.truth import many_splats, red_splat
from tests.fuzz.cost import Meter

_CPU_S, _MIB = 2.0, 128.0


def refused(read: Callable[[Path], Any], path: Path, *words: str) -> None:
    """With one error, soon and in little memory."""
    meter = Meter()
    with pytest.raises(SplatError) as caught:
        read(path)
    cost = meter.stop()
    assert cost.cpu_s < _CPU_S
    assert cost.peak_mib < _MIB
    assert not isinstance(caught.value.__cause__, MemoryError)
    for word in words:
        assert word in caught.value.given


def written(folder: Path, name: str, count: int = 1) -> Path:
    path = folder / name
    formats.write(path, many_splats(count) if count > 1 else red_splat())
    return path


def test_a_ply_of_very_many_properties_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "a.ply")
    more = "".join(f"property char a{i:x}\n" for i in range(45_000)).encode()
    head, _, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(head + more + b"end_header\n" + body)
    refused(formats.read, path, "properties")


def test_an_spz_that_unpacks_to_very_many_splats_is_refused(tmp_path: Path) -> None:
    count = 3_200_000
    header = struct.pack("<4sIIBBBB", MAGIC, 3, count, 0, 12, 0, 0)
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header + bytes(20 * count)))
    refused(formats.read, path, "declares")


def test_an_spz_of_very_many_extensions_is_read_soon(tmp_path: Path) -> None:
    whole = gzip.decompress(written(tmp_path, "a.spz").read_bytes())
    flags = whole[:14] + bytes([whole[14] | 2]) + whole[15:]
    path = tmp_path / "b.spz"
    path.write_bytes(gzip.compress(flags + struct.pack("<II", 7, 0) * ((1 << 17) - 1)))
    meter = Meter()
    assert len(formats.read(path)) == 1
    assert meter.stop().cpu_s < _CPU_S


@pytest.mark.parametrize("packing", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_sog_whose_parts_are_packed_as_no_other_is_refused(tmp_path: Path, packing: int) -> None:
    whole, path = written(tmp_path, "a.sog"), tmp_path / "b.sog"
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            content += b" " * (1 << 27) if name == "meta.json" else b""
            new.writestr(name, content, packing if name == "meta.json" else zipfile.ZIP_STORED)
            if name == "meta.json":
                new.getinfo(name).file_size = 1000  # what the directory of the file then says
    refused(formats.read, path)


def test_a_sog_of_more_splats_than_bytes_is_refused(tmp_path: Path) -> None:
    whole, path = written(tmp_path, "a.sog", 40), tmp_path / "b.sog"
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "meta.json":
                content = json.dumps({**json.loads(content), "count": 1_200_000}).encode()
            new.writestr(name, content)
        new.writestr("padding", bytes(1_000_000))
    refused(formats.read, path, "count")


def test_a_list_that_names_a_chunk_twice_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "lod-meta.json", 40)
    meta = json.loads(path.read_text())
    (name,) = meta["filenames"]
    leaf = {"lods": {"0": {"file": 0, "offset": 0, "count": 40}}}
    leaves = [json.loads(json.dumps(leaf)) for _ in range(3)]
    for number, each in enumerate(leaves):
        each["lods"]["0"]["file"] = number
    meta["filenames"] = [name, name, f"./{name}"]
    meta["tree"] = {"children": leaves}
    path.write_text(json.dumps(meta))
    refused(formats.read, path, "twice")


def test_a_list_of_very_many_levels_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "lod-meta.json", 40)
    path.write_text(json.dumps({**json.loads(path.read_text()), "lodLevels": 200_000_000}))
    splats = formats.read(path)
    refused(lambda place: streamed_sog.splat_widths(place, splats), path, "levels")


def test_a_gltf_whose_buffers_are_one_file_is_refused(tmp_path: Path) -> None:
    """Each node's splats are within the bytes of all buffers, if one file counts many times."""
    path = written(tmp_path, "a.gltf", 3000)
    document = json.loads(path.read_text())
    times, views = 40, len(document["bufferViews"])
    document["buffers"] *= times
    document["bufferViews"] = [
        {**view, "buffer": i} for i in range(times) for view in document["bufferViews"]
    ]
    document["accessors"] = [
        {**each, "bufferView": each["bufferView"] + i * views}
        for i in range(times)
        for each in document["accessors"]
    ]
    (primitive,) = document["meshes"][0]["primitives"]
    document["meshes"] = [
        {
            "primitives": [
                {
                    **primitive,
                    "attributes": {k: v + i * views for k, v in primitive["attributes"].items()},
                }
            ]
        }
        for i in range(times)
    ]
    document["nodes"] = [{"mesh": i} for i in range(times)]
    document["scenes"] = [{"nodes": list(range(times))}]
    path.write_text(json.dumps(document))
    refused(formats.read, path, "share")


def test_a_page_that_unpacks_to_very_much_is_refused(tmp_path: Path) -> None:
    import base64

    path = written(tmp_path, "a.html")
    page = path.read_bytes()
    found = re.search(rb'(<script[^>]*class="splats"[^>]*>)([A-Za-z0-9+/=]*)(</script>)', page)
    assert found is not None
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    splats = zlib.decompress(base64.b64decode(found[2]), 31)
    bomb = (
        packer.compress(splats)
        + b"".join(packer.compress(bytes(1 << 24)) for _ in range(40))
        + packer.flush()
    )
    middle = found[1] + base64.b64encode(bomb) + found[3]
    path.write_bytes(page[: found.start()] + middle + page[found.end() :])
    refused(formats.read, path, "unpack")


def test_a_usd_file_whose_prims_are_made_of_others_is_refused(tmp_path: Path) -> None:
    """Every prim inherits twice from the next: 2^20 prims from a kilobyte."""
    path = written(tmp_path, "a.usda")
    prims = "".join(
        f'def Xform "L{i}" {{\n def Xform "a" (inherits = </L{i + 1}>) {{}}\n'
        f' def Xform "b" (inherits = </L{i + 1}>) {{}}\n}}\n'
        for i in range(20)
    )
    path.write_text(path.read_text() + prims + 'def Xform "L20" {}\n')
    refused(formats.read, path, "each other")


def test_a_picture_of_cameras_that_claims_very_many_pixels_is_refused(tmp_path: Path) -> None:
    out = io.BytesIO()
    Image.new("L", (20, 20)).save(out, "PNG")
    png = bytearray(out.getvalue())
    png[16:24] = struct.pack(">II", 60_000, 60_000)
    png[29:33] = struct.pack(">I", zlib.crc32(png[12:29]))
    (tmp_path / "a.png").write_bytes(png)
    with pytest.raises(ValueError, match=r"a\.png"):
        size_of_picture(tmp_path, "a.png")
    path = tmp_path / "transforms.json"
    path.write_text('{"frames": [{"file_path": "a.png", "fl_x": 1}]}')
    refused(nerfstudio.read, path, "a.png")


@pytest.mark.parametrize("content", [b'"name"x,y\n', b"name," + b"x" * 140_000 + b"\n"])
def test_a_table_of_cameras_with_a_damaged_head_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    refused(realityscan.read, path)


@pytest.mark.parametrize("content", ["[]", "7", '{"frames": 1}'])
def test_points_of_no_document_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(content)
    refused(nerfstudio.read_points, path)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("lists", ["", "property list uchar int a\n"])
def test_points_that_claim_very_many_are_refused(tmp_path: Path, kind: str, lists: str) -> None:
    (tmp_path / "transforms.json").write_text('{"frames": [], "ply_file_path": "a.ply"}')
    properties = "".join(f"property float {name}\n" for name in "xyz") + lists
    header = f"ply\nformat {kind} 1.0\nelement vertex 99999999\n{properties}end_header\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + b"0 0 0\n")
    refused(nerfstudio.read_points, tmp_path / "transforms.json")


@pytest.mark.parametrize("exposure", [1e-300, 1e300])
@pytest.mark.parametrize("f_number", [1e-300, 1e300])
@pytest.mark.parametrize("iso", [5e-324, 1e308])
def test_the_exposure_of_any_numbers_is_a_number(
    exposure: float, f_number: float, iso: float
) -> None:
    found = Exif(exposure_s=exposure, f_number=f_number, iso=iso).exposure_ev
    assert found is not None
    assert np.isfinite(found)


def test_the_end_of_a_jpeg_with_a_long_fill_is_found_soon() -> None:
    scan = b"\xff\xd8\xff\xda\x00\x02"
    meter = Meter()
    assert jpeg_fault(scan + (b"\xff" * 60_000 + b"\x00") * 3)
    assert not jpeg_fault(scan + b"\xff" * 60_000 + b"\x00\x01" + b"\xff\xff\xd9")
    assert meter.stop().cpu_s < _CPU_S


def test_a_jpeg_of_very_many_scans_is_refused(tmp_path: Path) -> None:
    """Each scan of a few bytes costs a walk over all pixels."""
    out = io.BytesIO()
    Image.new("L", (2048, 2048)).save(out, "JPEG", progressive=True)
    whole = out.getvalue()
    path = tmp_path / "a.jpg"
    path.write_bytes(whole[:-2] + whole[whole.rindex(b"\xff\xda") : -2] * 3000 + whole[-2:])
    meter = Meter()
    with readers_set_up(), pytest.raises(Unusable, match="scans"):
        decode(path, 1600, PixelBudget(1 << 28))
    assert meter.stop().cpu_s < _CPU_S
    path.write_bytes(whole)
    with readers_set_up():
        assert decode(path, 1600, PixelBudget(1 << 28)).stored == (2048, 2048)


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_stored_splats_of_no_size_are_refused(tmp_path: Path, value: float) -> None:
    path = save_splats(tmp_path / "splats.bin", red_splat())
    whole = path.read_bytes()
    side = len(whole) - 8 * (len(fields(DrawSettings)) - 1)  # the second of the last block
    path.write_bytes(whole[:side] + np.float64(value).tobytes() + whole[side + 8 :])
    refused(load_splats, path)


@pytest.mark.parametrize("data", [{"photographs": 7}, {"settings": [1]}])
def test_a_run_file_of_other_types_is_refused(tmp_path: Path, data: dict[str, Any]) -> None:
    write_sealed(tmp_path / RUN_FILE, data)
    refused(lambda path: RunFile.read(path.parent), tmp_path / RUN_FILE)


def test_a_manifest_of_deep_lists_is_refused(tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_text("[" * 100_000)
    refused(lambda path: Manifest.read(path.parent), tmp_path / MANIFEST)
