"""Runs configurations of structure from motion: databases, worker jobs and what is kept to resume.

Everything lies under one work folder. A finished step leaves a marker file, and a run that was
killed continues after the last marker. Unfinished extraction and matching continue inside COLMAP's
database, whose content does not depend on how often it was interrupted.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from zipfile import BadZipFile

import numpy as np

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.sfm.checks.fallbacks import CONFIGURATIONS, Attempt, Configuration
from stages.sfm.checks.gates import (
    ModelStatistics,
    check_keypoints,
    check_model,
    check_pairs,
    connected_groups,
)
from stages.sfm.checks.statistics import model_statistics
from stages.sfm.worker import database as sqlite
from stages.sfm.worker.chunks import (
    ChunkExecutor,
    extract_features_in_chunks,
    match_pairs_in_chunks,
)
from stages.sfm.worker.job import Job
from stages.sfm.worker.process import WorkerCrashed, WorkerTimedOut, run_step
from stages.sfm.worker.sparse_model import load_result, without_implausible_views

MORE_FEATURES = 2.0  # factor on the number of features
LOWER_PEAK = 0.4  # factor on SIFT's peak threshold


@dataclass
class AttemptRunner:
    """Runs configurations for one capture.

    Args:
        folder: the work folder.
        base: the job of the standard configuration, which the others vary.
        report: receives progress, and says when to stop.
        deadline: of all configurations together, in seconds of `time.monotonic`.
        allow_partial: go on to mapping although the gates before it failed.
        join_all: match learned features for all photographs, also for those that SIFT registers.
        executor: runs chunks of features and matching; None: one worker process does it all.
        seconds: wall-clock seconds of each step so far, over all configurations.
    """

    folder: Path
    base: Job
    report: Report
    deadline: float
    allow_partial: bool = False
    join_all: bool = False
    executor: ChunkExecutor | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    def out_of_time(self) -> bool:
        return self.seconds_left() <= 0

    def seconds_left(self) -> float:
        return self.deadline - time.monotonic()

    def run_configuration(self, configuration: Configuration) -> Attempt:
        """Features, matches, mapping and all gates of one configuration.

        Raises SplatError for crashes of extraction and matching, and Interrupted.
        """
        frames = self.base.frames
        photographs = int(frames.max()) + 1
        empty = ModelStatistics(photographs=photographs)
        job = self._job(configuration)
        try:
            self._extract_features(job)
            if configuration.learned:
                try:
                    job = self._match_learned(self._match(job, configuration))
                except WorkerCrashed as crash:  # SIFT's model may do
                    return Attempt(configuration, (crash,), empty)
            found = sqlite.keypoint_counts(Path(job.database), len(frames))
            counts = np.bincount(frames, found).astype(int).tolist()
            attempt = Attempt(configuration, (), empty, keypoints_median=float(median(counts)))
            failures = check_keypoints(counts)
            # A partial model may come of few features, but more features are tried before that.
            if failures and not (self.allow_partial and configuration.more_features):
                return replace(attempt, failures=tuple(failures))
            if not configuration.learned:
                job = self._match(job, configuration)
            verified = self._verified_pairs(Path(job.database))
            attempt = replace(
                attempt,
                pairs_matched=len(sqlite.inliers_of_pairs(Path(job.database))),
                pairs_verified=len(verified),
            )
            failures = check_pairs(verified, photographs)
            unmatched = any(failure.code == "sfm-no-matches" for failure in failures)
            if failures and (unmatched or not self.allow_partial):
                return replace(attempt, failures=tuple(failures))
        except WorkerTimedOut as late:
            return Attempt(configuration, (late,), empty)
        return self._mapped(job, attempt, failures)

    def _mapped(self, job: Job, attempt: Attempt, before: list[SplatError]) -> Attempt:
        """The attempt with the model of `job` and its failures, added to those `before`."""
        try:
            self._map(job, attempt.configuration)
        except WorkerTimedOut:
            statistics = replace(attempt.statistics, timed_out=True)
            return replace(attempt, statistics=statistics, failures=tuple(check_model(statistics)))
        except WorkerCrashed as crash:
            return replace(attempt, failures=(crash,))
        result = load_result(Path(job.out))
        if result.model is not None:
            result = replace(result, model=without_implausible_views(result.model))
        statistics = model_statistics(result, attempt.statistics.photographs)
        statistics = replace(statistics, learned=attempt.configuration.learned)
        failures = tuple(before) + tuple(check_model(statistics))
        return replace(attempt, statistics=statistics, failures=failures, result=result)

    def _verified_pairs(self, database: Path) -> list[tuple[int, int, int, int]]:
        """`database.verified_pairs` with numbers of frames for positions."""
        frames = self.base.frames.tolist()
        pairs = sqlite.verified_pairs(database)
        return [(frames[first], frames[second], *rest) for first, second, *rest in pairs]

    def _job(self, configuration: Configuration) -> Job:
        base, more = self.base, configuration.more_features
        model_folder = "model-" + re.sub(r"\W+", "-", configuration.name)
        return replace(
            base,
            database=str(self.folder / ("more.db" if more else "base.db")),
            out=str(self.folder / model_folder),
            max_features=round(base.max_features * (MORE_FEATURES if more else 1)),
            peak_threshold=base.peak_threshold * (LOWER_PEAK if more else 1.0),
            matching="exhaustive" if more else base.matching,
            drop_stationary=configuration.drop_stationary,
            loose=configuration.loose,
            strongest_start=configuration.strongest_start,
        )

    def _extract_features(self, job: Job) -> None:
        database = Path(job.database)
        marker = database.with_suffix(".features-done")
        if marker.exists() and database.exists():
            return
        sqlite.repair_or_delete(database)
        if self.executor is not None:
            with self._timed("features"):
                extract_features_in_chunks(job, self.executor, self._check_deadline)
        self._run(replace(job, step="features"))
        marker.touch()

    def _match(self, job: Job, configuration: Configuration) -> Job:
        """Match; returns the job with the database that holds the two-view geometries to use."""
        database = Path(job.database)
        if configuration.drop_stationary:
            copied = database.with_name(database.stem + "-moving.db")
            if not copied.exists():
                sqlite.copy(database, copied)
                sqlite.delete_geometries(copied)
            database = copied
            job = replace(job, database=str(copied))
        marker = database.with_suffix(f".{job.matching}-done")
        if marker.exists() and database.exists():
            return job
        if not configuration.drop_stationary:
            sqlite.repair(database)
        if self.executor is not None:
            self._match_in_chunks(job, self.executor)
        self._run(replace(job, step="matching"))
        marker.touch()
        return job

    def _match_learned(self, job: Job) -> Job:
        """Add learned features and matches to those of the matched `job`; returns the job with the
        database of both."""
        source = Path(job.database)
        target = source.with_name(f"{source.stem}-learned.db")
        learned = replace(job, database=str(target), source=job.database)
        if not target.exists():  # it appears when it is complete
            photographs = self._unregistered(source)
            self._run(replace(learned, step="learned", photographs=photographs))
        return learned

    def _unregistered(self, database: Path) -> tuple[int, ...]:
        """Positions of the photographs that SIFT left out: of its model, or where mapping was not
        reached, of the largest group that its matches link."""
        everyone = range(len(self.base.names))
        model_folder = Path(self._job(CONFIGURATIONS[0]).out)
        registered: set[int] = set()
        if self.join_all:
            pass
        elif _is_mapped(model_folder):
            model = load_result(model_folder).model
            names = () if model is None else without_implausible_views(model).names
            registered = {self.base.names.index(name) for name in names}
        else:
            frames = self.base.frames
            linked = connected_groups(self._verified_pairs(database), int(frames.max()) + 1)[0]
            registered = set(np.flatnonzero(np.isin(frames, linked)).tolist())
        return tuple(i for i in everyone if i not in registered)

    def _match_in_chunks(self, job: Job, executor: ChunkExecutor) -> None:
        """Match until no pair is left to select; the selection depends on earlier matches."""
        left = 1
        while left:
            self._run(replace(job, step="pair selection"))
            with self._timed("matching"):
                left = match_pairs_in_chunks(job, executor, self._check_deadline)

    def _check_deadline(self) -> None:
        if self.out_of_time():
            raise WorkerTimedOut(len(self.base.names))

    def _map(self, job: Job, configuration: Configuration) -> None:
        if _is_mapped(Path(job.out)):
            return
        budget = min(self.seconds_left(), mapping_seconds(len(job.names)))
        job = replace(job, step="mapping", max_seconds=max(1, int(budget)))
        suffix = "" if configuration is CONFIGURATIONS[0] else f" ({configuration.name})"
        # COLMAP checks its own time limit only between photographs.
        self._run(job, suffix, job.max_seconds + 60.0)

    def _run(self, job: Job, suffix: str = "", max_seconds: float | None = None) -> None:
        """Run one step in a worker. suffix: of the phases in progress reports."""
        seconds = self.seconds_left() if max_seconds is None else max_seconds
        with self._timed("matching" if job.step == "pair selection" else job.step):
            run_step(job, self.folder, self.report, seconds, suffix)

    @contextmanager
    def _timed(self, step: str) -> Iterator[None]:
        started = time.monotonic()
        try:
            yield
        finally:
            self.seconds[step] = self.seconds.get(step, 0.0) + time.monotonic() - started


def mapping_seconds(photographs: int) -> float:
    """Time limit of one mapping: several times what good captures need on two slow cores. Captures
    that cannot be mapped would otherwise go on without end."""
    return 240.0 + 10.0 * photographs


def _is_mapped(out: Path) -> bool:
    """Whether an earlier run finished this mapping before its time limit."""
    try:
        return not load_result(out).timed_out
    except (OSError, ValueError, BadZipFile):
        return False
