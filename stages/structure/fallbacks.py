"""What to try next when a reconstruction fails its gates.

Each rung names the failures that it can mend, so that no time goes into rungs that cannot help:
nothing but other photographs mends a lack of parallax.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from stages.structure.gates import Failure, ModelStatistics
from stages.structure.sparse_model import MappingResult


@dataclass(frozen=True)
class Configuration:
    """One way to reconstruct.

    more_features: lower SIFT's threshold and allow more. exhaustive: match every pair even where
    the settings say otherwise. drop_stationary, loose, other_pair, mapper: as in `job.Job`.
    mends: codes of the failures for which this rung is worth its time.
    """

    name: str
    more_features: bool = False
    exhaustive: bool = False
    drop_stationary: bool = False
    loose: bool = False
    other_pair: bool = False
    mapper: str = "incremental"
    mends: frozenset[str] = frozenset()


_UNPLACED = frozenset({"sfm-too-few-registered", "sfm-no-model", "sfm-weak-photographs"})
_SPARSE = frozenset({"sfm-too-few-points", "sfm-short-tracks", "sfm-too-few-features"})
_UNLINKED = frozenset({"sfm-separate-groups", "sfm-no-matches"})
_CAMERA = frozenset({"sfm-implausible-distortion", "sfm-implausible-focal"})

CONFIGURATIONS = (
    Configuration("standard"),
    Configuration("without stationary matches", drop_stationary=True, mends=_CAMERA),
    Configuration("looser registration", loose=True, mends=_UNPLACED),
    Configuration("every pair matched", exhaustive=True, mends=_UNPLACED | _UNLINKED | _SPARSE),
    Configuration(
        "more features",
        more_features=True,
        exhaustive=True,
        loose=True,
        mends=_UNPLACED | _UNLINKED | _SPARSE,
    ),
    Configuration(
        "another first pair",
        exhaustive=True,
        loose=True,
        other_pair=True,
        mends=_UNPLACED | _CAMERA | {"sfm-high-error", "sfm-crashed"},
    ),
    Configuration(
        "global mapper", exhaustive=True, mapper="global", mends=_UNPLACED | {"sfm-crashed"}
    ),
)


@dataclass(frozen=True)
class Attempt:
    """What one rung gave. failures: empty if it passed. result: None where mapping was not
    reached. keypoints_median: before matching. pairs_matched, pairs_verified: of photographs that
    were compared in full, and that were found to show the same thing."""

    rung: Configuration
    failures: tuple[Failure, ...]
    figures: ModelStatistics
    result: MappingResult | None = None
    keypoints_median: float = 0.0
    pairs_matched: int = 0
    pairs_verified: int = 0

    @property
    def passed(self) -> bool:
        return not self.failures

    @property
    def merit(self) -> tuple[int, int, int, int]:
        """For choosing among attempts that failed: the more photographs and points, the better,
        then those of any model, who know best why it is none; the global mapper's word counts
        least."""
        trusted = self.figures.mapper != "global"
        found = max(self.figures.models, default=0)
        return (int(trusted), self.figures.registered, self.figures.points, found)


@dataclass
class Attempts:
    """All attempts in order, and the one to use: the first that passed, else the best."""

    attempts: list[Attempt] = field(default_factory=list)

    @property
    def best(self) -> Attempt:
        for attempt in self.attempts:
            if attempt.passed:
                return attempt
        return max(self.attempts, key=lambda attempt: attempt.merit)


def try_configurations(
    try_rung: Callable[[Configuration], Attempt],
    *,
    already_exhaustive: bool,
    out_of_time: Callable[[], bool],
) -> Attempts:
    """Try rungs until one passes, none that is left can mend what failed, or time is up.

    already_exhaustive: the settings match every pair anyway, so that a rung which adds nothing
    else is skipped.
    """
    climbed = Attempts()
    wanted: set[str] = set()
    for rung in CONFIGURATIONS:
        if rung is not CONFIGURATIONS[0] and not _worth_trying(rung, wanted, already_exhaustive):
            continue
        if climbed.attempts and out_of_time():
            break
        attempt = try_rung(rung)
        climbed.attempts.append(attempt)
        if attempt.passed:
            break
        wanted = {failure.code for failure in attempt.failures}
    return climbed


def _worth_trying(rung: Configuration, failures: set[str], already_exhaustive: bool) -> bool:
    if "sfm-no-parallax" in failures:
        return False
    only_exhaustive = rung == Configuration(rung.name, exhaustive=True, mends=rung.mends)
    if already_exhaustive and only_exhaustive:
        return False
    return bool(rung.mends & failures)
