"""One rung after another, made real: which databases, which jobs, what is kept for resuming.

Everything lies under one work folder. A step that is finished leaves a marker, and a run that was
killed goes on after the last marker; half-done extraction and matching go on inside COLMAP's
database, whose content does not depend on how often it was interrupted.
"""

from __future__ import annotations

import json
import re
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from stages.base.atomic import replacing
from stages.base.stage import Report
from stages.structure import database as sqlite
from stages.structure import worker_progress
from stages.structure.chunks import ChunkExecutor, extract_features_in_chunks, match_pairs_in_chunks
from stages.structure.fallbacks import CONFIGURATIONS, Attempt, Configuration
from stages.structure.gates import (
    Failure,
    ModelStatistics,
    check_keypoints,
    check_model,
    check_pairs,
)
from stages.structure.job import Job, compared_pairs_path
from stages.structure.process import WorkerCrashed, WorkerTimedOut, crash_error, run_worker
from stages.structure.sparse_model import load_result, model_statistics, without_implausible_views

MORE_FEATURES = 2.0  # times as many, at most
LOWER_PEAK = 0.4  # times SIFT's peak threshold
_SECONDS = "seconds.json"


@dataclass
class AttemptRunner:
    """Runs rungs for one capture. base: the job that rungs vary. deadline: time.monotonic().
    hands: who does shares of features and matching; None: this machine, unshared."""

    folder: Path
    base: Job
    report: Report
    deadline: float
    allow_partial: bool = False
    executor: ChunkExecutor | None = None

    def out_of_time(self) -> bool:
        return self.seconds_left() <= 0

    def seconds_left(self) -> float:
        return self.deadline - time.monotonic()

    def try_rung(self, rung: Configuration) -> Attempt:
        """Features, matches, mapping and all gates for one rung.

        Raises SplatError for crashes of extraction and matching, and Interrupted.
        """
        photographs = len(self.base.names)
        nothing = ModelStatistics(photographs=photographs, mapper=rung.mapper)
        job = self._job(rung)
        try:
            self._features(job)
            counts = sqlite.keypoint_counts(Path(job.database), photographs)
            attempt = Attempt(rung, (), nothing, keypoints_median=float(median(counts)))
            failures = check_keypoints(counts)
            if failures and not self._hopeful(rung):
                return replace(attempt, failures=tuple(failures))
            job = self._matching(job, rung)
            verified = sqlite.verified_pairs(Path(job.database))
            attempt = replace(
                attempt,
                pairs_matched=len(sqlite.inliers_of_pairs(Path(job.database))),
                pairs_verified=len(verified),
            )
            failures = check_pairs(verified, photographs)
            if failures and not self.allow_partial:
                return replace(attempt, failures=tuple(failures))
            if any(failure.code == "sfm-no-matches" for failure in failures):
                return replace(attempt, failures=tuple(failures))
        except WorkerTimedOut:
            return Attempt(rung, (_too_slow(photographs),), nothing)
        except WorkerCrashed as crash:
            raise crash_error(crash, self.folder) from crash
        return self._mapped(job, attempt, failures)

    def _hopeful(self, rung: Configuration) -> bool:
        """Whether to go on with few features: only if there is no richer rung to come."""
        return self.allow_partial and rung.more_features

    def _mapped(self, job: Job, attempt: Attempt, before: list[Failure]) -> Attempt:
        try:
            self._mapping(job, attempt.rung)
        except WorkerTimedOut:
            figures = replace(attempt.figures, timed_out=True)
            return replace(attempt, figures=figures, failures=tuple(check_model(figures)))
        except WorkerCrashed as crash:
            error = crash_error(crash, self.folder)
            failure = Failure(error.code, error.given, error.wanted, error.hint)
            return replace(attempt, failures=(failure,))
        result = load_result(Path(job.out))
        if result.model is not None:
            result = replace(result, model=without_implausible_views(result.model))
        figures = model_statistics(result, len(self.base.names), attempt.rung.mapper)
        failures = tuple(before) + tuple(check_model(figures))
        return replace(attempt, figures=figures, failures=failures, result=result)

    def _job(self, rung: Configuration) -> Job:
        base = self.base
        name = "more" if rung.more_features else "base"
        return replace(
            base,
            database=str(self.folder / f"{name}.db"),
            out=str(self.folder / ("model-" + re.sub(r"\W+", "-", rung.name))),
            progress=str(self.folder / "progress.json"),
            max_features=round(base.max_features * (MORE_FEATURES if rung.more_features else 1)),
            peak_threshold=base.peak_threshold * (LOWER_PEAK if rung.more_features else 1.0),
            matching="exhaustive" if rung.exhaustive else base.matching,
            drop_stationary=rung.drop_stationary,
            mapper=rung.mapper,
            loose=rung.loose,
            other_pair=rung.other_pair,
        )

    def _features(self, job: Job) -> None:
        database = Path(job.database)
        marker = database.with_suffix(".features-done")
        if marker.exists() and database.exists():
            return
        if database.exists():
            _repair_or_delete(database)
        if self.executor is not None:
            with self._timed("features"):
                extract_features_in_chunks(job, self.executor, self._look)
        self._run(replace(job, step="features"), lambda: self._tick(job, "photographs"))
        marker.touch()

    def _matching(self, job: Job, rung: Configuration) -> Job:
        """Match; returns the job with the database that holds the geometries to use."""
        database = Path(job.database)
        if rung.drop_stationary:
            copied = database.with_name(database.stem + "-moving.db")
            if not copied.exists():
                sqlite.copy(database, copied)
                sqlite.forget_geometries(copied)
            database = copied
            job = replace(job, database=str(copied))
        marker = database.with_suffix(f".{job.matching}-done")
        if marker.exists() and database.exists():
            return job
        if not rung.drop_stationary:
            sqlite.repair(database)
        if self.executor is not None:
            self._share_matching(job, self.executor)
        self._run(replace(job, step="matching"), lambda: self._tick(job, "pairs"))
        marker.touch()
        return job

    def _share_matching(self, job: Job, executor: ChunkExecutor) -> None:
        """Until no pairs are left to choose: which those are depends on how the others matched."""
        left = 1
        while left:
            self._run(replace(job, step="choosing"), lambda: self._tick(job, "photographs"))
            with self._timed("matching"):
                left = match_pairs_in_chunks(job, executor, self._look)

    def _look(self) -> None:
        """At the clock."""
        if self.out_of_time():
            raise WorkerTimedOut

    def _mapping(self, job: Job, rung: Configuration) -> None:
        if _finished(Path(job.out)):
            return
        total = len(job.names)
        more = "" if rung is CONFIGURATIONS[0] else f" ({rung.name})"
        budget = min(self.seconds_left(), mapping_seconds(total))
        timed = replace(job, step="mapping", max_seconds=max(1, int(budget)))

        # COLMAP looks at its own clock only between photographs.
        self._run(timed, lambda: self._tick(job, "photographs", more), timed.max_seconds + 60.0)

    def _run(self, job: Job, tick: Callable[[], None], max_seconds: float | None = None) -> None:
        seconds = self.seconds_left() if max_seconds is None else max_seconds
        Path(job.progress).unlink(missing_ok=True)
        with self._timed("matching" if job.step == "choosing" else job.step):
            run_worker(job, self.folder, self.report.stop_requested, seconds, tick)

    @contextmanager
    def _timed(self, step: str) -> Iterator[None]:
        started, before = time.monotonic(), self.seconds_by_step()
        try:
            yield
        finally:
            before[step] = before.get(step, 0.0) + time.monotonic() - started
            with replacing(self.folder / _SECONDS) as path:
                path.write_text(json.dumps(before))

    def seconds_by_step(self) -> dict[str, float]:
        """Of all rungs and of interrupted runs; wall clock."""
        try:
            return dict(json.loads((self.folder / _SECONDS).read_text()))
        except (OSError, ValueError):
            return {}

    def pairs_looked_at(self) -> int:
        """By the first looks, each pair counted once."""
        path = compared_pairs_path(self._job(CONFIGURATIONS[0]))
        return int(path.read_text()) if path.exists() else 0

    def _tick(self, job: Job, unit: str, more: str = "") -> None:
        """Pass on how far the worker says it is."""
        told = worker_progress.read_progress(Path(job.progress))
        if told is not None:
            phase, done, total = told
            self.report.progress(done, total, phase + more, **{unit: done})


def mapping_seconds(photographs: int) -> float:
    """Time for one mapping: several times what good captures need on two slow cores, because
    captures that cannot be mapped go on for ever."""
    return 240.0 + 10.0 * photographs


def _repair_or_delete(database: Path) -> None:
    try:
        sqlite.repair(database)
    except sqlite3.DatabaseError:
        sqlite.delete(database)


def _finished(out: Path) -> bool:
    """Whether an earlier run came to the end of this mapping, and not of its time."""
    try:
        return not load_result(out).timed_out
    except (OSError, ValueError):
        return False


def _too_slow(photographs: int) -> Failure:
    return Failure(
        "sfm-timed-out",
        f"Features and matches of {photographs} photographs were not ready in time.",
        "The search must come to an end.",
        "Allow more time with --max-minutes, or use fewer or smaller photographs (--max-side).",
    )
