"""Progress of placing photographs, which COLMAP interrupts to adjust all cameras."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from stages.structure.placing import Placing
from stages.structure.worker_progress import ProgressWriter, read_progress

PHOTOGRAPHS = 300
PLACING_S, ADJUSTING_S = 0.15, 0.05  # each photograph; each photograph that is there
AT_THE_END = {"quick": 3.0, "usual": 5.0, "slow": 6.2}  # times an adjustment
STEP_S = 0.1


class Clock:
    """Goes on as it is told to, and notes what `placing` says meanwhile."""

    def __init__(self) -> None:
        self.now = 0.0
        self.said: list[tuple[float, int]] = []

    def __call__(self) -> float:
        return self.now

    def spend(self, seconds: float, placing: Placing) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now = min(self.now + STEP_S, end)
            self.said.append((self.now, placing.told()))


def placed(folder: Path, at_the_end: float = AT_THE_END["usual"]) -> Clock:
    """A whole mapping as COLMAP does it. at_the_end: adjustments when all are placed."""
    clock = Clock()
    placing = Placing(ProgressWriter(folder / "ticks"), PHOTOGRAPHS, clock)
    placing.began()
    adjusted = 2
    for count in range(3, PHOTOGRAPHS + 1):
        clock.spend(PLACING_S, placing)
        if count >= 1.2 * adjusted:
            adjusted = count
            clock.spend(ADJUSTING_S * count, placing)
        placing.placed()
    clock.spend(at_the_end * ADJUSTING_S * PHOTOGRAPHS, placing)
    return clock


@pytest.mark.parametrize("end", AT_THE_END.values(), ids=AT_THE_END.keys())
def test_no_two_seconds_pass_without_progress(end: float, tmp_path: Path) -> None:
    changes = [0.0]
    said = placed(tmp_path, end).said
    changes += [now for (_, before), (now, told) in itertools.pairwise(said) if told > before]
    assert max(b - a for a, b in itertools.pairwise(changes)) < 2.0
    assert 0.7 * PHOTOGRAPHS < said[-1][1] <= PHOTOGRAPHS
    assert all(before <= told for (_, before), (_, told) in itertools.pairwise(said))


@pytest.mark.parametrize("share", [0.2, 0.4, 0.55])
def test_the_time_left_can_be_believed(share: float, tmp_path: Path) -> None:
    said = placed(tmp_path).said
    now, told = next(pair for pair in said if pair[1] >= share * PHOTOGRAPHS)
    left = said[-1][0] - now
    assert now / told * (PHOTOGRAPHS - told) == pytest.approx(left, rel=0.4)


def test_it_is_told_while_the_mapper_is_silent(tmp_path: Path) -> None:
    path = tmp_path / "ticks"
    with Placing(ProgressWriter(path), 5) as placing:
        placing.began()
        while (told := read_progress(path)) is None or told[1] < 1:
            pass
    assert told == ("placing photographs", 1, 5)


def test_settling_what_is_placed_is_told_of(tmp_path: Path) -> None:
    clock = Clock()
    placing = Placing(ProgressWriter(tmp_path / "ticks"), PHOTOGRAPHS, clock)
    placing.began()
    for _ in range(PHOTOGRAPHS // 2):  # the others cannot be placed
        clock.spend(PLACING_S, placing)
        placing.placed()
    before = placing.told()
    placing.ending()
    clock.spend(5.0, placing)
    assert before < placing.told() < PHOTOGRAPHS
