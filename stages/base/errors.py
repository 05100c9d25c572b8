"""The error class that users see.

A `SplatError` says what was given, what was wanted and what to do next. It has a stable code for
scripts and documentation, and an exit status for its family, so that a shell can tell bad input
from a bad reconstruction from a full disk.
"""

from __future__ import annotations

from enum import IntEnum

CRASHED = 1  # exit status after an unexpected failure
STOPPED = 130  # exit status after Ctrl-C, as shells expect it


class Family(IntEnum):
    """Exit status of each family of errors (see also `CRASHED` and `STOPPED`)."""

    USAGE = 2  # wrong option, wrong order of commands
    INPUT = 3  # photographs or files that cannot be used
    RECONSTRUCTION = 4  # structure from motion failed its gates
    RUN_FOLDER = 5  # a run folder that is missing, of another version, edited or damaged
    RESOURCES = 6  # disk, memory, permissions
    QUALITY = 7  # a result that failed its own check


class SplatError(Exception):
    """A problem that the user can act on.

    code: stable, kebab-case, prefixed by the part it comes from ("sfm-too-few-registered").
    given, wanted, hint: one or two sentences each. `hint` says what to do next.
    family: where it is known only when the error is raised; else that of the class.
    """

    family = Family.INPUT

    def __init__(
        self, code: str, *, given: str, wanted: str, hint: str, family: Family | None = None
    ) -> None:
        super().__init__(f"{given} {wanted} {hint}")
        self.code = code
        self.given = given
        self.wanted = wanted
        self.hint = hint
        self.family = family or type(self).family

    def as_dict(self) -> dict[str, str | int]:
        """The error as JSON data, for `--json`."""
        return {
            "code": self.code,
            "given": self.given,
            "wanted": self.wanted,
            "hint": self.hint,
            "family": int(self.family),
        }


class UsageError(SplatError):
    """See `Family.USAGE`."""

    family = Family.USAGE


class ReconstructionError(SplatError):
    """See `Family.RECONSTRUCTION`."""

    family = Family.RECONSTRUCTION


class RunFolderError(SplatError):
    """See `Family.RUN_FOLDER`."""

    family = Family.RUN_FOLDER


class ResourceError(SplatError):
    """See `Family.RESOURCES`."""

    family = Family.RESOURCES


class QualityError(SplatError):
    """See `Family.QUALITY`."""

    family = Family.QUALITY


class Interrupted(Exception):  # noqa: N818 - a normal way to stop, not an error
    """A stage stopped at a safe boundary at the user's request; its checkpoint is on disk."""
