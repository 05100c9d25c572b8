"""A limit of time is the whole command's: training and pruning share what earlier stages leave."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from stages.base.stage import Stage
from stages.prune.settings import PruneSettings
from stages.run.pipeline import Pipeline
from stages.run.time_limit import LEAST_S, within_limit
from stages.train.settings import TrainSettings
from tests.run.fakes import photographs

SLOW = 0.5  # seconds that the first stage takes


@dataclass(frozen=True)
class NoSettings:
    pass


@dataclass(frozen=True)
class Limited:
    seconds: float = field(default=0.0, metadata={"help": "limit in seconds"})


def limit_of_training(tmp_path: Path, until: str | None) -> float:
    """The limit that training gets, of 100 seconds, after a slow stage."""
    limits = []
    stages = [
        Stage("sfm", 1, (), NoSettings, lambda *_: time.sleep(SLOW), lambda _: ""),
        Stage("train", 1, ("sfm",), Limited, lambda _, s, *__: limits.append(s.seconds), str),
    ]
    pipeline = Pipeline(tmp_path / "run", photographs(tmp_path / "photos"), stages)
    pipeline.run({"train": Limited(100.0)}, until)
    manifest = pipeline.manifest("train")
    assert manifest
    assert manifest.settings == {"seconds": 100.0}  # as given: the same command changes nothing
    return float(limits[0])


def test_training_gets_a_part_of_what_the_stages_before_it_left(tmp_path: Path) -> None:
    limit = limit_of_training(tmp_path, None)
    assert 30 < limit < 60


def test_the_limit_of_a_single_stage_is_its_own(tmp_path: Path) -> None:
    assert limit_of_training(tmp_path, "train") == 100.0


@pytest.mark.parametrize(("stage", "kind"), [("train", TrainSettings), ("prune", PruneSettings)])
def test_without_a_limit_there_is_none_and_when_time_is_over_a_second_is_left(stage, kind) -> None:
    assert within_limit(stage, kind(), 1000.0) == kind()
    assert within_limit(stage, kind(seconds=60.0), 100.0).seconds == LEAST_S
    assert 20 < within_limit(stage, kind(seconds=60.0), 10.0).seconds < 40
