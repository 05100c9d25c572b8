"""Valid but extreme splats survive every file that claims to hold everything."""

from __future__ import annotations

import pytest

from tests.extremes.files import EXTREMES, KEPT_FORMATS, through_a_file


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("suffix", KEPT_FORMATS)
def test_an_extreme_splat_draws_the_same_after_a_file(suffix: str, name: str) -> None:
    beyond = [m for m in through_a_file("cpu", suffix, name) if not m.accepted]
    assert not beyond, "\n".join(f"{m.what}: {m.error:.3g} > {m.bound:.3g}" for m in beyond)
