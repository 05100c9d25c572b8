"""Which configuration to try next when a reconstruction fails its gates.

Each configuration lists the failures that it may fix, so that no time is spent on those that cannot
help: only other photographs fix a lack of parallax.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from stages.base.errors import SplatError
from stages.sfm.checks.gates import ModelStatistics, poses_contradicted
from stages.sfm.worker.sparse_model import MappingResult


@dataclass(frozen=True)
class Configuration:
    """One way to run structure from motion.

    Args:
        name: for messages and metrics.
        more_features: lower SIFT's peak threshold, allow more features, and match every pair.
        learned: add learned features and their matches to SIFT's.
        loose, strongest_start: as in `job.Mapping`.
        fixes: codes of the failures after which this configuration is tried.
    """

    name: str
    more_features: bool = False
    learned: bool = False
    loose: bool = False
    strongest_start: bool = False
    fixes: frozenset[str] = frozenset()


_UNREGISTERED = frozenset({"sfm-too-few-registered", "sfm-no-model"})
_SPARSE = frozenset({"sfm-too-few-points", "sfm-too-few-features"})
_UNCONNECTED = frozenset({"sfm-separate-groups", "sfm-no-matches"})
_FALSE_JOIN = frozenset({"sfm-weak-link", "sfm-contradictions"})

LEARNED = Configuration(
    "learned features",
    learned=True,
    fixes=_UNREGISTERED | _UNCONNECTED | _SPARSE | {"sfm-weak-link"},
)
# For a model that passed although several pairs contradict it: another may fit them better.
ANOTHER_START = Configuration("another initial pair", strongest_start=True)
CONFIGURATIONS = (  # by SIFT alone
    Configuration("standard"),
    Configuration("looser registration", loose=True, fixes=_UNREGISTERED | {"sfm-crashed"}),
    Configuration(
        "more features",
        more_features=True,
        loose=True,
        fixes=_UNREGISTERED | _UNCONNECTED | _SPARSE,
    ),
)


@dataclass(frozen=True)
class Attempt:
    """The result of one configuration.

    Args:
        configuration: what was run.
        failures: of its gates; empty if it passed.
        statistics: of the model found.
        result: of mapping; nothing if it was not reached.
        keypoints_median: per photograph.
        pairs_matched: pairs whose features were matched.
        pairs_verified: pairs with a two-view geometry.
    """

    configuration: Configuration
    failures: tuple[SplatError, ...]
    statistics: ModelStatistics
    result: MappingResult = field(default_factory=MappingResult)
    keypoints_median: float = 0.0
    pairs_matched: int = 0
    pairs_verified: int = 0

    @property
    def passed(self) -> bool:
        return not self.failures

    @property
    def inconsistent_share(self) -> float:
        """The share of pairs whose verified matches contradict the poses."""
        found = self.statistics
        return (found.pairs_inconsistent - found.pairs_turned) / max(1, found.pairs_checked)

    @property
    def rank(self) -> tuple[bool, int, int, int]:
        """Orders attempts that failed, the best highest: by registered photographs, then by points,
        then by the largest model. Models that learned features may have joined falsely are below
        all others."""
        largest = max(self.statistics.models, default=0)
        failures = {failure.code for failure in self.failures}
        false = self.configuration.learned and bool(failures & _FALSE_JOIN)
        return (not false, self.statistics.registered, self.statistics.points, largest)


def best_attempt(attempts: list[Attempt]) -> Attempt:
    """Of the attempts that passed, the first with the most registered photographs; if none passed,
    the one of the highest rank. The model from another initial pair replaces the standard one if at
    most half as many pairs contradict it, and does not count otherwise."""
    passed = [attempt for attempt in attempts if attempt.passed]
    again = [attempt for attempt in passed if attempt.configuration is ANOTHER_START]
    if again:
        standard = next(a for a in passed if a.configuration is CONFIGURATIONS[0])
        better = again[0].inconsistent_share <= standard.inconsistent_share / 2
        passed.remove(standard if better else again[0])
    if passed:
        return max(passed, key=lambda attempt: attempt.statistics.registered)
    return max(attempts, key=lambda attempt: attempt.rank)


def configurations(features: str) -> tuple[Configuration, ...]:
    """The configurations in order. features: "sift", "auto" (learned features after the standard
    ones) or "learned" (first)."""
    first, *others = CONFIGURATIONS
    if features == "sift":
        return (first, ANOTHER_START, *others)
    if features == "learned":
        return (LEARNED, first, ANOTHER_START, *others)
    return (first, ANOTHER_START, LEARNED, *others)


def try_configurations(
    run: Callable[[Configuration], Attempt],
    *,
    out_of_time: Callable[[], bool],
    features: str = "sift",
) -> list[Attempt]:
    """The attempts, in order, until one passes, no configuration left may help, or time is up.

    Two configurations are tried although an earlier one passed: learned features if the first
    attempt leaves photographs out, and another initial pair if pairs contradict the poses of the
    standard one.

    Args:
        run: runs one configuration.
        out_of_time: whether to stop; the first configuration is run all the same.
        features: as in `configurations`.
    """
    attempts: list[Attempt] = []
    for configuration in configurations(features):
        if attempts:
            if not _may_help(configuration, attempts):
                continue
            if out_of_time():
                break
        attempts.append(run(configuration))
    return attempts


def _may_help(configuration: Configuration, attempts: list[Attempt]) -> bool:
    if any(attempt.passed for attempt in attempts):
        if configuration is ANOTHER_START:
            last = attempts[-1]
            standard = last.configuration is CONFIGURATIONS[0]
            return standard and last.passed and poses_contradicted(last.statistics)
        return configuration.learned and attempts[0].statistics.left_out > 0
    by_sift = [attempt for attempt in attempts if not attempt.configuration.learned]
    failures = {failure.code for failure in (by_sift or attempts)[-1].failures}
    if "sfm-no-parallax" in failures:
        return False
    if configuration is CONFIGURATIONS[0]:
        return True
    return bool(configuration.fixes & failures)
