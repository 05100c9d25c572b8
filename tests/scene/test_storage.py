"""Splats on disk between stages."""

from __future__ import annotations

from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest

from stages.base.errors import Family, SplatError
from stages.scene import Splats, load_splats, save_splats, storage
from stages.scene.storage import FIELDS


def some_splats(n: int, degree: int = 2, dtype: type = np.float32) -> Splats:
    rng = np.random.default_rng(n + degree)
    return Splats(
        means=rng.normal(size=(n, 3)).astype(dtype),
        quaternions=rng.normal(size=(n, 4)).astype(dtype),
        log_scales=rng.normal(size=(n, 3)).astype(dtype),
        opacity_logits=rng.normal(size=n).astype(dtype),
        sh=rng.normal(size=(n, (degree + 1) ** 2, 3)).astype(dtype),
        sh_degrees=np.full(n, degree, np.uint8),
        origin=np.array([1e6 + 1 / 3, -2.0, 0.1]),
    )


@pytest.mark.parametrize("n", [0, 1, 1000])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_splats_come_back_bit_for_bit(tmp_path: Path, n: int, dtype: type) -> None:
    splats = some_splats(n, dtype=dtype)
    if n:  # values that are wrong must survive as well: a stage's output is what it was
        splats.means[0, 0] = np.nan
        splats.log_scales[0, 0] = -np.inf
    file = save_splats(tmp_path / "a.bin", splats)
    back = load_splats(file)
    for name in FIELDS:
        wanted, got = getattr(splats, name), getattr(back, name)
        assert got.dtype == wanted.dtype
        assert got.tobytes() == wanted.tobytes()


def test_equal_splats_give_equal_bytes_whatever_their_memory_layout(tmp_path: Path) -> None:
    splats = some_splats(50)
    twisted = replace(splats, means=np.asfortranarray(splats.means), sh=splats.sh[:, ::1])
    first, second = save_splats(tmp_path / "a", splats), save_splats(tmp_path / "b", twisted)
    assert first.read_bytes() == second.read_bytes()


def test_a_folder_gets_the_file_inside(tmp_path: Path) -> None:
    assert save_splats(tmp_path, some_splats(3)).parent == tmp_path
    assert len(load_splats(tmp_path)) == 3
    assert len(list(tmp_path.iterdir())) == 1


def test_a_damaged_file_is_named_at_every_cut(tmp_path: Path) -> None:
    whole = save_splats(tmp_path / "whole", some_splats(4, 0)).read_bytes()
    damaged = tmp_path / "damaged"
    for content in [whole[:k] for k in range(0, len(whole), 7)] + [whole + b"x", b"PK" + whole]:
        damaged.write_bytes(content)
        with pytest.raises(SplatError) as caught:
            load_splats(damaged)
        assert caught.value.code == "splats-file-damaged"
        assert "damaged" in caught.value.given


def test_a_huge_count_asks_for_no_memory(tmp_path: Path) -> None:
    content = save_splats(tmp_path / "a", some_splats(4, 0)).read_bytes()
    (tmp_path / "a").write_bytes(content.replace(b"(4, 3), }         ", b"(4000000000, 3), }", 1))
    with pytest.raises(SplatError):
        load_splats(tmp_path / "a")


def test_an_unwritable_place_is_an_error_of_its_own(tmp_path: Path) -> None:
    with pytest.raises(SplatError) as caught:
        save_splats(tmp_path / "missing" / "a", some_splats(1))
    assert caught.value.family == Family.RESOURCES
    assert list(tmp_path.iterdir()) == []


def test_a_file_of_an_earlier_version_with_a_sixth_draw_setting_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    splats = some_splats(5).with_antialias(True)
    monkeypatch.setattr(storage, "astuple", lambda settings: (*astuple(settings), 1.0))
    save_splats(tmp_path / "six.bin", splats)
    assert load_splats(tmp_path / "six.bin").draw_settings == splats.draw_settings
