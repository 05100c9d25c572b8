"""The Python API refuses what it does not know before it does anything; test_docs_run runs it."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatcli.api import process
from stages.base.errors import SplatError


def test_unknown_option_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="no stage has the option colour"):
        process(tmp_path, tmp_path / "run", colour="red")
    assert not (tmp_path / "run").exists()


def test_unknown_preset_is_refused_with_those_that_exist(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="preview, standard, best"):
        process(tmp_path, tmp_path / "run", preset="quick")


def test_value_out_of_range_is_the_error_of_the_command(tmp_path: Path) -> None:
    with pytest.raises(SplatError, match="--train-side 3") as caught:
        process(tmp_path, tmp_path / "run", train_side=3)
    assert caught.value.code == "option-value"
    assert not (tmp_path / "run").exists()
