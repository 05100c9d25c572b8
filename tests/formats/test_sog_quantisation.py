"""Splats in fewer bits: a file that is smaller, and holds exactly what was rounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages import formats
from stages.formats import FORMATS
from stages.formats.axes import smallest_rotations
from stages.formats.sog_quantisation import BitDepths, quantise_for_sog, splats_to_write
from stages.scene import QuantisedSplats, Splats, morton
from stages.scene.rotations import matrices_of
from tests.formats.truth import many_splats

FEW = BitDepths(position=12, rotation=5, scale=5, colour=5, opacity=5, palette=6)


def test_a_file_holds_what_was_rounded_and_is_smaller(tmp_path) -> None:
    splats = many_splats(3000).with_sh_degree(0)
    rounded = quantise_for_sog(splats, FEW)
    sizes = []
    for name, held in (("a", splats), ("b", rounded)):
        path = tmp_path / f"{name}.sog"
        formats.write(path, held)
        sizes.append(path.stat().st_size)
    assert sizes[1] < 0.8 * sizes[0]
    read = formats.read(tmp_path / "b.sog")
    wanted = rounded.take(morton.morton_order(rounded))
    np.testing.assert_allclose(read.means, wanted.means, atol=2e-4)
    np.testing.assert_allclose(read.log_scales, wanted.log_scales, atol=1e-5)
    np.testing.assert_allclose(read.sh, wanted.sh, atol=1e-5)
    np.testing.assert_allclose(read.opacity_logits, wanted.opacity_logits, rtol=1e-5, atol=1e-5)


def test_each_value_keeps_its_bits() -> None:
    splats = many_splats(3000).with_sh_degree(0)
    rounded = quantise_for_sog(splats, FEW)
    assert len(np.unique(rounded.log_scales)) <= 32
    assert len(np.unique(rounded.sh[:, 0])) <= 32
    assert len(np.unique(rounded.opacity_logits)) <= 33  # the end of the grid stays its end
    extent = np.ptp(splats.means, axis=0)
    assert (np.abs(rounded.means - splats.means) < extent / 1000).all()


def test_a_palette_of_few_rows_is_written_as_it_was_chosen(tmp_path) -> None:
    splats = many_splats(3000)
    rounded = quantise_for_sog(splats, FEW)
    kinds = rounded.sh[:, 1:].reshape(len(rounded), -1)
    assert 32 < len(np.unique(kinds, axis=0)) <= 64
    formats.write(tmp_path / "a.sog", rounded)
    read = formats.read(tmp_path / "a.sog").sh[:, 1:].reshape(len(rounded), -1)
    assert len(np.unique(read, axis=0)) <= 64
    wanted = kinds[morton.morton_order(rounded)]
    assert np.abs(read - wanted).max() < 0.02 * np.ptp(wanted)


def test_axes_named_anew_are_the_same_ellipsoids_turned_less() -> None:
    splats = many_splats(3000)
    found = smallest_rotations(splats)
    for one, other in zip(covariances(splats), covariances(found), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * np.abs(one).max())
    assert found.quaternions[:, 0].min() > 0.85  # 63 degrees: no cube is farther from itself
    assert splats.quaternions[:, 0].min() < 0.1
    again = smallest_rotations(found)
    np.testing.assert_allclose(again.quaternions, found.quaternions, atol=1e-6)


def covariances(splats: Splats) -> np.ndarray:
    """[N, 3, 3]"""
    axes = matrices_of(splats.quaternions) * np.exp(splats.log_scales)[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_only_formats_that_compress_are_quantised() -> None:
    splats = many_splats(100)
    quantised = QuantisedSplats(splats, vars(FEW))
    for name, row in FORMATS.items():
        held = splats_to_write(row, quantised)
        assert np.array_equal(held.means, splats.means) == (name != "sog"), name


@pytest.mark.parametrize("name", ["splat", "ply"])
def test_without_view_dependence_colours_are_the_mean_of_what_photographs_see(name) -> None:
    splats = many_splats(50)
    flat = np.full((50, 3), 0.25, np.float32)
    held = splats_to_write(FORMATS[name], QuantisedSplats(splats, None, flat))
    assert (held.sh[:, 0] == 0.25).all() == (name == "splat")
    same = replace(splats, sh=splats.sh[:, :1], sh_degrees=splats.sh_degrees * 0)
    assert np.array_equal(splats_to_write(FORMATS[name], QuantisedSplats(same)).sh, same.sh)
