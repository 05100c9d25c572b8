"""Splats in fewer bits: a file that is smaller, and holds exactly what was rounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages import formats
from stages.formats import FORMATS
from stages.formats.coarse import Bits, held_by, of_sog
from stages.scene import QuantisedSplats, morton
from tests.formats.truth import many_splats

FEW = Bits(position=12, rotation=5, scale=5, colour=5, opacity=5)


def test_a_file_holds_what_was_rounded_and_is_smaller(tmp_path) -> None:
    splats = many_splats(3000).with_sh_degree(0)
    rounded = of_sog(splats, FEW)
    sizes = []
    for name, held in (("a", splats), ("b", rounded)):
        path = tmp_path / f"{name}.sog"
        formats.write(path, held)
        sizes.append(path.stat().st_size)
    assert sizes[1] < 0.8 * sizes[0]
    read = formats.read(tmp_path / "b.sog")
    wanted = rounded.take(morton.order(rounded))
    np.testing.assert_allclose(read.means, wanted.means, atol=2e-4)
    np.testing.assert_allclose(read.log_scales, wanted.log_scales, atol=1e-5)
    np.testing.assert_allclose(read.sh, wanted.sh, atol=1e-5)
    np.testing.assert_allclose(read.opacity_logits, wanted.opacity_logits, rtol=1e-5, atol=1e-5)


def test_each_value_keeps_its_bits() -> None:
    splats = many_splats(3000).with_sh_degree(0)
    rounded = of_sog(splats, FEW)
    assert len(np.unique(rounded.log_scales)) <= 32
    assert len(np.unique(rounded.sh[:, 0])) <= 32
    assert len(np.unique(rounded.opacity_logits)) <= 33  # the end of the grid stays its end
    extent = np.ptp(splats.means, axis=0)
    assert (np.abs(rounded.means - splats.means) < extent / 1000).all()


def test_only_formats_that_pack_are_told_in_fewer_bits() -> None:
    splats = many_splats(100)
    quantised = QuantisedSplats(splats, 3, {"bits": vars(FEW)})
    for name, row in FORMATS.items():
        held = held_by(row, quantised)
        assert np.array_equal(held.means, splats.means) == (name != "sog"), name


@pytest.mark.parametrize("name", ["splat", "ply"])
def test_without_view_dependence_colours_are_the_mean_of_what_photographs_see(name) -> None:
    splats = many_splats(50)
    flat = np.full((50, 3), 0.25, np.float32)
    held = held_by(FORMATS[name], QuantisedSplats(splats, 3, {}, flat))
    assert (held.sh[:, 0] == 0.25).all() == (name == "splat")
    same = replace(splats, sh=splats.sh[:, :1], sh_degrees=splats.sh_degrees * 0)
    assert np.array_equal(held_by(FORMATS[name], QuantisedSplats(same, 0, {})).sh, same.sh)
