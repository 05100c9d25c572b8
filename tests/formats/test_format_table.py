"""The table of formats says what is true of the files, and nothing else."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from stages import formats
from stages.base.errors import Family, SplatError
from stages.formats import BY_ENDING, FORMATS, Format
from stages.formats.codecs import CODECS
from stages.formats.mesh_files import CODECS_OF_MESHES
from stages.formats.mesh_table import MESHES
from stages.proof.checks import CHECKS
from stages.scene import Splats
from tests.formats.files import read
from tests.formats.truth import many_splats


def test_every_format_has_its_functions_and_its_checks() -> None:
    assert list(CODECS) == list(CHECKS) == list(BY_ENDING)
    assert list(CODECS_OF_MESHES) == list(MESHES)


def rows_of_file(row: Format, splats: Splats) -> NDArray[np.intp]:
    order = CODECS[row.ending].order
    return order(splats) if order else np.arange(len(splats))


@pytest.mark.parametrize("row", FORMATS.values(), ids=lambda row: row.ending)
def test_a_writer_takes_views_where_its_row_says_so(row: Format) -> None:
    assert ("views" in inspect.signature(CODECS[row.ending].write).parameters) == row.takes_views


@pytest.mark.parametrize("row", FORMATS.values(), ids=lambda row: row.ending)
def test_rows_of_a_file_are_in_the_order_of_the_table(tmp_path: Path, row: Format) -> None:
    splats = many_splats(200)
    path = tmp_path / f"a.{row.ending}"
    formats.write(path, splats)
    order = rows_of_file(row, splats)
    back = read(path)
    np.testing.assert_allclose(back.means, splats.means[order], atol=0.02)
    assert back.sh_degree == row.sh_degree


@pytest.mark.parametrize("row", FORMATS.values(), ids=lambda row: row.ending)
def test_formats_lose_what_their_rows_declare_and_nothing_else(tmp_path: Path, row: Format) -> None:
    splats = many_splats(200)
    path = tmp_path / f"a.{row.ending}"
    formats.write(path, splats)
    order = rows_of_file(row, splats)
    back, wanted = read(path).with_sh_degree(3), splats.take(order)
    pairs = [(getattr(back, n), getattr(wanted, n)) for n in ("means", "sh", "opacities")]
    same = all(np.allclose(a, b, atol=1e-6) for a, b in pairs)
    assert same == (not row.loses)


@pytest.mark.parametrize("row", FORMATS.values(), ids=lambda row: row.ending)
def test_a_format_leaves_the_files_that_its_row_names(tmp_path: Path, row: Format) -> None:
    path = tmp_path / f"a b.{row.ending}"
    formats.write(path, replace(many_splats(9), origin=np.zeros(3)))
    assert sorted(row.files(path)) == sorted(tmp_path.iterdir())
    assert row.size_bytes(path) == sum(file.stat().st_size for file in tmp_path.iterdir())


@pytest.mark.parametrize("ending", MESHES)
def test_a_mesh_is_neither_read_nor_written_as_splats(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"A.{ending}".upper()
    for attempt in (lambda: formats.read(path), lambda: formats.write(path, many_splats(3))):
        with pytest.raises(SplatError, match="name of a mesh") as caught:
            attempt()
        assert (caught.value.code, caught.value.family) == ("format-mesh", Family.USAGE)
        assert f"splat export --format {ending}" in caught.value.hint
    assert not list(tmp_path.iterdir())


def test_the_longest_ending_decides() -> None:
    assert formats.format_of(Path("a.glb")).ending == "glb"
    assert formats.format_of(Path("a.b.Compressed.PLY")).ending == "compressed.ply"
    assert formats.format_of(Path("compressed.ply")).ending == "ply"
