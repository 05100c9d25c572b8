"""The parts of each run, in the order of their value: the first are done if time runs out."""

from __future__ import annotations

import sys
from dataclasses import dataclass

PYTEST = ("-m", "pytest", "--noconftest", "-p", "no:cacheprovider", "-m", "gpu")
TESTED = ("tests/raster/test_gpu.py", "tests/train/steps/test_gpu.py")
# What the interpreter can do of these in a minute.
TOY_TESTED = ("-n", "0", "-k", "equal_depths or the_same_twice")


@dataclass(frozen=True)
class Part:
    """One process.

    Args:
        name: of the part, of its result file and of its output in the log.
        limit_s: after which it is killed.
        words: of its command line after the interpreter; "RESULT" and "BUNDLE" are replaced.
        group: parts that follow each other and have the same group run side by side; "" for alone.
        behind: goes on beside all that follows it, until one that names it in `needs`.
        needs: the part that must have ended before.
        prefix: a program that runs the interpreter.
        toy: words that replace `words` with --toy, or that are added if `words` name a module.
    """

    name: str
    limit_s: float
    words: tuple[str, ...]
    group: str = ""
    behind: bool = False
    needs: str = ""
    prefix: tuple[str, ...] = ()
    toy: tuple[str, ...] = ("--toy",)

    def command(self, toy: bool) -> list[str]:
        """The command line, before its words are replaced."""
        prefix = () if toy else self.prefix
        return [*prefix, sys.executable, *self.words, *(self.toy if toy else ())]


def own(name: str, limit_s: float, *words: str, module: str = "", **how: str | bool) -> Part:
    """A part that is a module of this package."""
    line = ("-m", f"tests.device.{module or name}", "--result", "RESULT", *words)
    prefix = tuple(str(how.pop("prefix", "")).split())
    return Part(name, limit_s, line, prefix=prefix, **how)  # type: ignore[arg-type]


def tests_part(limit_s: float) -> Part:
    # a line for each test, so that what was done is known where time runs out
    more = ("-n", "6", "--dist", "load", "-v", "-k", "not compiles_within")
    words = (*PYTEST, *TESTED, "--durations=5", "--timeout=100")
    return Part("tests", limit_s, (*words, *more), group="correct", toy=TOY_TESTED)


SANITIZER = "compute-sanitizer --error-exitcode 7 --print-limit 20 --tool"
FIRST = (
    own("versions", 45),
    own("build_theirs", 200, "--bundle", "BUNDLE", behind=True),
    own("warm", 75),
    tests_part(100),
    own("hostile", 100, group="correct"),
    own("memcheck", 100, module="sanitised", group="correct", prefix=f"{SANITIZER} memcheck"),
    own("racecheck", 100, module="sanitised", group="correct", prefix=f"{SANITIZER} racecheck"),
    own("steps", 90),
    own("training", 60, "--bundle", "BUNDLE"),
    own("theirs", 45, "--bundle", "BUNDLE", needs="build_theirs"),
    own("host", 40),
    own("sweep", 50, "--sweep", "1", module="steps"),
    own("large", 90, "--large", "1", module="hostile"),
)
SECOND = (
    own("versions", 30),
    own("warm", 75),
    own("rows", 120, group="correct"),
    own("rows_float32", 120, "--real", "float32", module="rows", group="correct"),
    own("hostile", 90, "--first", "1000", group="correct"),
    tests_part(100),
    own("sweep", 60, "--sweep", "1", module="steps"),
    own("counters", 90),
    own("steps", 60),
    own("training", 60, "--bundle", "BUNDLE"),
    own("training_cpu", 240, "--bundle", "BUNDLE", "--backend", "cpu", module="training"),
)
THIRD = (
    own("versions", 30),
    own("warm", 75),
    own("bonsai", 500, "--bundle", "BUNDLE", "--run", "bonsai", module="training"),
)
FOURTH = (
    own("versions", 30),
    own("warm", 75),
    own("lego", 170, "--bundle", "BUNDLE", "--run", "lego", module="training"),
    own("chair", 170, "--bundle", "BUNDLE", "--run", "chair", module="training"),
    own("mic", 170, "--bundle", "BUNDLE", "--run", "mic", module="training"),
)
RUNS = {1: FIRST, 2: SECOND, 3: THIRD, 4: FOURTH}
SECONDS = {1: 420.0, 2: 300.0, 3: 590.0, 4: 590.0}
