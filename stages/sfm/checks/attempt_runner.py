"""Runs configurations of structure from motion: databases, worker jobs, and what is kept to resume.

Everything lies under one work folder. A finished step leaves a marker file, and a run that was
killed continues after the last marker. Unfinished extraction and matching continue inside COLMAP's
database, whose content does not depend on how often it was interrupted.
"""

from __future__ import annotations

import re
import time
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
from stages.sfm.worker.job import (
    Features,
    Job,
    Learned,
    Mapping,
    Matching,
    Project,
    Sift,
    derived_paths,
)
from stages.sfm.worker.process import WorkerCrashed, WorkerTimedOut, run_step
from stages.sfm.worker.sparse_model import load_result, without_implausible_views

MORE_FEATURES = 2.0  # factor on the number of features
LOWER_PEAK = 0.4  # factor on SIFT's peak threshold


@dataclass
class AttemptRunner:
    """Runs configurations for one capture.

    Args:
        project: of the standard configuration, in the work folder.
        sift: settings of the standard configuration, which others vary.
        report: receives progress, and says when to stop.
        deadline: of all configurations together, in seconds of `time.monotonic`.
        allow_partial: go on to mapping although the gates before it failed.
        join_all: match learned features for all photographs, also for those that SIFT registers.
        seconds: wall-clock seconds of each step so far, over all configurations.
    """

    project: Project
    sift: Sift
    report: Report
    deadline: float
    allow_partial: bool = False
    join_all: bool = False
    seconds: dict[str, float] = field(default_factory=dict)

    def out_of_time(self) -> bool:
        return self.seconds_left() <= 0

    def seconds_left(self) -> float:
        return self.deadline - time.monotonic()

    def run_configuration(self, configuration: Configuration) -> Attempt:
        """Features, matches, mapping and all gates of one configuration.

        Raises SplatError for crashes of extraction and matching, and Interrupted.
        """
        frames = self.project.photographs.frames
        photographs = int(frames.max()) + 1
        empty = ModelStatistics(photographs=photographs)
        try:
            project = self._with_features(configuration)
            if configuration.learned:
                try:
                    project = self._with_learned(self._with_matches(project, configuration))
                except WorkerCrashed as crash:  # SIFT's model may do
                    return Attempt(configuration, (crash,), empty)
            found = sqlite.keypoint_counts(project.database, len(frames))
            counts = np.bincount(frames, found).astype(int).tolist()
            attempt = Attempt(configuration, (), empty, keypoints_median=float(median(counts)))
            failures = check_keypoints(counts)
            # A partial model may come of few features, but more features are tried before that.
            if failures and not (self.allow_partial and configuration.more_features):
                return replace(attempt, failures=tuple(failures))
            if not configuration.learned:
                project = self._with_matches(project, configuration)
            verified = self._verified_pairs(project.database)
            attempt = replace(
                attempt,
                pairs_matched=len(sqlite.inliers_of_pairs(project.database)),
                pairs_verified=len(verified),
            )
            failures = check_pairs(verified, photographs)
            unmatched = any(failure.code == "sfm-no-matches" for failure in failures)
            if failures and (unmatched or not self.allow_partial):
                return replace(attempt, failures=tuple(failures))
        except WorkerTimedOut as late:
            return Attempt(configuration, (late,), empty)
        return self._mapped(project, attempt, failures)

    def _mapped(self, project: Project, attempt: Attempt, before: list[SplatError]) -> Attempt:
        """The attempt with the model of `project` and its failures, added to those `before`."""
        try:
            self._map(project, attempt.configuration)
        except WorkerTimedOut:
            statistics = replace(attempt.statistics, timed_out=True)
            return replace(attempt, statistics=statistics, failures=tuple(check_model(statistics)))
        except WorkerCrashed as crash:
            return replace(attempt, failures=(crash,))
        result = load_result(self._model_folder(attempt.configuration))
        if result.model is not None:
            result = replace(result, model=without_implausible_views(result.model))
        statistics = model_statistics(result, attempt.statistics.photographs)
        statistics = replace(statistics, learned=attempt.configuration.learned)
        failures = tuple(before) + tuple(check_model(statistics))
        return replace(attempt, statistics=statistics, failures=failures, result=result)

    def _verified_pairs(self, database: Path) -> list[tuple[int, int, int, int]]:
        """`database.verified_pairs` with numbers of frames for positions."""
        frames = self.project.photographs.frame_of
        pairs = sqlite.verified_pairs(database)
        return [(frames[i], frames[j], inliers, kind) for i, j, inliers, kind in pairs]

    def _model_folder(self, configuration: Configuration) -> Path:
        name = "model-" + re.sub(r"\W+", "-", configuration.name)
        return self.project.database.with_name(name)

    def _with_features(self, configuration: Configuration) -> Project:
        """Extract features; returns the project with their database."""
        project, sift = self.project, self.sift
        if configuration.more_features:
            project = replace(project, database=project.database.with_name("more.db"))
            most = round(sift.max_features * MORE_FEATURES)
            sift = Sift(most, sift.peak_threshold * LOWER_PEAK)
        marker = project.database.with_suffix(".features-done")
        matched = (_matched_marker(project.database, how) for how in ("auto", "exhaustive"))
        sqlite.usable(project.database, marker, *matched, *derived_paths(project.database))
        if not marker.exists():
            self._run(Features(project, sift))
            marker.touch()
        return project

    def _with_matches(self, project: Project, configuration: Configuration) -> Project:
        """Match; returns the project with the database of the two-view geometries to use."""
        how = "exhaustive" if configuration.more_features else "auto"
        marker = _matched_marker(project.database, how)
        if not marker.exists():
            self._run(Matching(project, how))
            marker.touch()
        return project

    def _with_learned(self, project: Project) -> Project:
        """Add learned features and their matches to those of SIFT in the database of `project`;
        returns the project with the database of both."""
        source = project.database
        project = replace(project, database=source.with_name(f"{source.stem}-learned.db"))
        if not sqlite.usable(project.database):  # it appears when it is complete
            self._run(Learned(project, source, self._unregistered(source)))
        return project

    def _unregistered(self, database: Path) -> tuple[int, ...]:
        """Positions of the photographs that SIFT left out of its model; where there is no model,
        those outside the largest group that its matches link."""
        all_names = self.project.photographs.names
        model_folder = self._model_folder(CONFIGURATIONS[0])
        registered: set[int] = set()
        if self.join_all:
            pass
        elif _is_mapped(model_folder):
            model = load_result(model_folder).model
            names = () if model is None else without_implausible_views(model).names
            registered = {all_names.index(name) for name in names}
        else:
            frames = self.project.photographs.frames
            linked = connected_groups(self._verified_pairs(database), int(frames.max()) + 1)[0]
            registered = set(np.flatnonzero(np.isin(frames, linked)).tolist())
        return tuple(i for i in range(len(all_names)) if i not in registered)

    def _map(self, project: Project, configuration: Configuration) -> None:
        out = self._model_folder(configuration)
        if _is_mapped(out):
            return
        budget = min(self.seconds_left(), mapping_seconds(len(project.photographs)))
        seconds = max(1, int(budget))
        job = Mapping(project, out, seconds, configuration.loose, configuration.strongest_start)
        suffix = "" if configuration is CONFIGURATIONS[0] else f" ({configuration.name})"
        # COLMAP checks its own time limit only between photographs.
        self._run(job, suffix, seconds + 60.0)

    def _run(self, job: Job, suffix: str = "", max_seconds: float | None = None) -> None:
        """Run one step in a worker. suffix: of the phases in progress reports."""
        seconds = self.seconds_left() if max_seconds is None else max_seconds
        started = time.monotonic()
        try:
            run_step(job, self.project.database.parent, self.report, seconds, suffix)
        finally:
            spent = self.seconds.get(job.step, 0.0) + time.monotonic() - started
            self.seconds[job.step] = spent


def _matched_marker(database: Path, how: str) -> Path:
    """The file that says that a database is matched. how: as in `job.Matching`."""
    return database.with_suffix(f".{how}-done")


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
