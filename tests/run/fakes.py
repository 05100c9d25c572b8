"""Three small stages: copy the photographs' bytes, count them, sign the count."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stages.base.settings import setting
from stages.base.stage import Report, Stage


@dataclass(frozen=True)
class CopySettings:
    upper: bool = field(default=False, metadata={"help": "capitals"})
    threads: int = field(default=1, metadata={"help": "cores", "affects_output": False})


@dataclass(frozen=True)
class CountSettings:
    iterations: int = setting(7000, "steps", min=1)
    seed: int = field(default=0, metadata={"help": "random seed"})
    tool: str = field(default="pen", metadata={"help": "what counts", "midway": True})


@dataclass(frozen=True)
class SignSettings:
    names: tuple[str, ...] = field(default=("a", "b"), metadata={"help": "who signs"})


def _copy(inputs: Mapping[str, Any], settings: CopySettings, folder: Path, report: Report) -> None:
    text = "".join(path.read_text() for path in sorted(inputs["photos"].glob("*.jpg")))
    (folder / "text").mkdir(exist_ok=True)
    (folder / "text" / "all.txt").write_text(text.upper() if settings.upper else text)
    report.metric("characters", len(text))


def _count(
    inputs: Mapping[str, Any], settings: CountSettings, folder: Path, report: Report
) -> None:
    (folder / "count.txt").write_text(f"{len(inputs['copy']) * settings.iterations}")
    report.progress(1, 1, "counting", letters=len(inputs["copy"]))
    report.warn("count-low", "Few letters. Write more.")


def _sign(inputs: Mapping[str, Any], settings: SignSettings, folder: Path, report: Report) -> None:
    (folder / "signed.txt").write_text(f"{inputs['count']} {' '.join(settings.names)}")


def _reader(name: str) -> Callable[[Path], str]:
    return lambda folder: (folder / name).read_text()


Run = Callable[[Mapping[str, Any], Any, Path, Report], Any]


def fake_stages(copy: Run = _copy, count: Run = _count, sign: Run = _sign) -> list[Stage]:
    """copy -> count -> sign, each replaceable."""
    return [
        Stage("copy", 1, (), CopySettings, copy, _reader("text/all.txt")),
        Stage("count", 1, ("copy",), CountSettings, count, _reader("count.txt")),
        Stage("sign", 1, ("count",), SignSettings, sign, _reader("signed.txt")),
    ]


def photographs(folder: Path, **texts: str) -> Path:
    """A folder with `a.jpg`, `b.jpg` ... of the given texts."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (texts or {"a": "one", "b": "two"}).items():
        (folder / f"{name}.jpg").write_text(text)
    return folder
