"""Pictures for people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stages.base import plots
from stages.train import charts
from stages.train.history import History, HistoryEntry


@pytest.mark.parametrize("name", ["Кухня 1.jpg", "台所.jpg", "Küche.jpg"])
def test_contact_sheet_never_shows_a_name_that_its_font_cannot_draw(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[str] = []
    monkeypatch.setattr(cv2, "putText", lambda image, text, *more: drawn.append(text))
    grey = np.full((30, 40, 3), 0.5, np.float32)
    charts.contact_sheet(
        tmp_path / "held_out.png",
        [("a.jpg", (21.5, 24, 27), grey, grey), (name, (20.25, 22, 25), grey, grey)],
    )
    assert drawn[0].startswith("1  a.jpg  ")
    assert drawn[1].startswith("2  (see held_out.txt)  ")
    assert "?" not in drawn[1]
    legend = (tmp_path / "held_out.txt").read_text(encoding="utf-8")
    first, second = legend.splitlines()
    assert first == "1  a.jpg  full size 21.50 dB, half size 24.00 dB, quarter size 27.00 dB"
    assert second.startswith(f"2  {name}  full size 20.25 dB")


def test_contact_sheet_of_nothing_is_none(tmp_path: Path) -> None:
    charts.contact_sheet(tmp_path / "held_out.png", [])
    assert not list(tmp_path.iterdir())


def test_the_plot_of_training_has_axes_units_and_a_legend(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Any] = []
    write = plots.write_plot

    def watched(path: Path, figure: Any) -> None:
        shown.append(figure)
        write(path, figure)

    monkeypatch.setattr(charts, "write_plot", watched)
    history = [HistoryEntry(s, 10 * s, 20.0 + s / 100) for s in (100, 200, 300)]
    charts.training_plot(tmp_path / "a.png", history)
    quality, counts = shown[0].axes
    assert (quality.get_xlabel(), quality.get_ylabel()) == ("step", "held-out PSNR (dB)")
    assert counts.get_ylabel() == "splats"
    assert [t.get_text() for t in quality.get_legend().get_texts()] == ["held-out PSNR", "splats"]
    charts.training_plot(tmp_path / "b.png", history)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_no_plot_of_training_without_held_out_photographs(tmp_path: Path) -> None:
    charts.training_plot(tmp_path / "a.png", [HistoryEntry(s, 5) for s in (1, 2, 3)])
    assert not list(tmp_path.iterdir())


def test_a_fall_of_held_out_psnr_is_told_with_its_step() -> None:
    values = (18.4, 12.2, 15.0, 18.9)
    entries = [HistoryEntry(100 * i, 5, value) for i, value in enumerate(values, 1)]
    fall_db, step = History(entries).largest_fall_db
    assert (round(fall_db, 1), step) == (6.2, 200)
    assert History([HistoryEntry(1, 5)]).largest_fall_db == (0.0, 0)
