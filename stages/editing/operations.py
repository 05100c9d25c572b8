"""What each word of a chain does. All are checked before the first begins."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages import formats
from stages.base.atomic import partial_prefix
from stages.base.errors import Family, SplatError
from stages.editing import expression, levels, regions, transform
from stages.editing.decimate import FAR_ROUND_SHARE, NEAR_ROUND_SHARE, decimate
from stages.editing.joining import joined
from stages.editing.scene import EditedScene
from stages.editing.syntax import OPERATIONS, ParsedOperation
from stages.editing.transform import Similarity
from stages.formats.values import drop_undrawable, select_rows
from stages.measure import floaters
from stages.measure.contribution import floaters as hanging
from stages.scene import Splats

Operation = Callable[[EditedScene], EditedScene]
_AXES = {"x": (1.0, 0, 0), "y": (0, 1.0, 0), "z": (0, 0, 1.0)}
_TRIES = 8  # to meet a size: one or two are enough where bytes grow with splats
_SPARE = 0.995


@dataclass(frozen=True)
class AppliedOperation:
    """One operation that was done. before, after: how many splats."""

    parsed: ParsedOperation
    before: int
    after: int
    scene: EditedScene


def prepare_operations(
    parsed: Sequence[ParsedOperation], target: Path
) -> list[tuple[ParsedOperation, Operation]]:
    """What to do; `target`: the file that comes of it. Raises SplatError for whatever of it is
    wrong, files that are named included."""
    return [(one, _prepared(one, target)) for one in parsed]


def apply_operations(
    scene: EditedScene, chain: Sequence[tuple[ParsedOperation, Operation]]
) -> Iterator[AppliedOperation]:
    """One operation after the other. Raises SplatError "edit-nothing-left"."""
    for parsed, operation in chain:
        before = len(scene.splats)
        scene = operation(scene)
        if before and not len(scene.splats):
            raise SplatError(
                "edit-nothing-left",
                given=f"{parsed} leaves none of {before:,} splats.",
                wanted="At least one.",
                hint="`splat info` tells the bounds, sizes and opacities of a file.",
                family=Family.USAGE,
            )
        yield AppliedOperation(parsed, before, len(scene.splats), scene)


def without_undrawable(splats: Splats) -> Splats:
    """Those that a viewer can draw: what operations may count on."""
    return drop_undrawable(splats)[0]


def _prepared(parsed: ParsedOperation, target: Path) -> Operation:
    value = parsed.value
    match parsed.word:
        case "crop":
            return _selecting(regions.parse_region(value).holds)
        case "drop":
            inside = regions.parse_region(value).holds
            return _selecting(lambda splats: ~inside(splats))
        case "keep":
            return _selecting(expression.parse_expression(value).holds)
        case "drop-floaters":
            return _without_floaters
        case "rotate":
            return _placing(Similarity(rotation=_rotation(parsed)))
        case "scale":
            return _placing(Similarity(scale=_number(parsed, 1e-9, 1e9)))
        case "move":
            return _placing(Similarity(offset=_vector(parsed, value)))
        case "up":
            return _placing(
                Similarity(rotation=transform.rotation_to_up(_direction(parsed, value)))
            )
        case "merge":
            return _merging(Path(value))
        case "degree":
            degree = int(_number(parsed, 0, 3, whole=True))
            return lambda scene: scene.with_splats(_of_degree(scene.splats, degree))
        case "decimate":
            return _decimating(parsed)
        case "max-mb":
            return _fitting(_number(parsed, 1e-6, 1e9) * 1e6, target)
    raise AssertionError(parsed.word)


def _selecting(holds: Callable[[Splats], NDArray[np.bool_]]) -> Operation:
    return lambda scene: scene.with_splats(select_rows(scene.splats, holds(scene.splats)))


def _of_degree(splats: Splats, degree: int) -> Splats:
    return splats.with_sh_degree(min(degree, splats.sh_degree))


def _placing(where: Similarity) -> Operation:
    return lambda scene: scene.transformed(where)


def _without_floaters(scene: EditedScene) -> EditedScene:
    if len(scene.photographs):
        gone = hanging(scene.splats, scene.worth(), scene.cameras())
    else:
        gone = floaters.isolated_splats(scene.splats)
    return scene.with_splats(select_rows(scene.splats, ~gone))


def _merging(path: Path) -> Operation:
    formats.format_of(path)
    if not path.is_file():
        raise SplatError(
            "file-missing",
            given=f"--merge {path} does not exist.",
            wanted="A splat file.",
            hint="Check the path.",
        )
    return lambda scene: scene.with_splats(
        joined(scene.splats, without_undrawable(formats.read(path)))
    )


def decimate_scene(scene: EditedScene, count: int) -> Splats:
    """By what photographs say where they are known, else by shape and colour."""
    if len(scene.photographs):
        return decimate(scene.splats, count, FAR_ROUND_SHARE, scene.removal_costs)
    return decimate(scene.splats, count, NEAR_ROUND_SHARE)


def _decimating(parsed: ParsedOperation) -> Operation:
    if parsed.value.endswith("%"):
        part = _number(ParsedOperation(parsed.word, parsed.value[:-1]), 1e-6, 100) / 100
        return lambda scene: scene.with_splats(
            decimate_scene(scene, round(part * len(scene.splats)))
        )
    count = int(_number(parsed, 1, 1e9, whole=True))
    return lambda scene: scene.with_splats(decimate_scene(scene, count))


def _fitting(most: float, target: Path) -> Operation:
    """At most so many bytes of `target`, measured on files that are really written."""
    row = formats.format_of(target)

    def size_bytes(scene: EditedScene) -> int:
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=partial_prefix()) as folder:
            path = Path(folder) / row.file_name("scene")
            levels.write(path, scene.splats, units=scene.units, views=scene.placed_views())
            return row.size_bytes(path)

    def fitted(scene: EditedScene) -> EditedScene:
        for _ in range(_TRIES):
            size, count = size_bytes(scene), len(scene.splats)
            if size <= most:
                return scene
            if count == 1:
                break
            scene = scene.with_splats(decimate_scene(scene, int(_SPARE * count * most / size)))
        raise SplatError(
            "edit-too-small",
            given=f"--max-mb {most / 1e6:g} is less than {count:,} splats take as .{row.ending}.",
            wanted=f"At least {np.ceil(size / 1e4) / 100:g}.",
            hint="Ask for more megabytes, or for another format.",
            family=Family.USAGE,
        )

    return fitted


def _rotation(parsed: ParsedOperation) -> NDArray[np.float64]:
    axis, _, degrees = parsed.value.rpartition(":")
    angle = regions.parse_numbers(degrees, 1)
    if angle is None:
        raise _wrong(parsed)
    return transform.rotation_about(_direction(parsed, axis), float(angle[0]))


def _direction(parsed: ParsedOperation, text: str) -> NDArray[np.float64]:
    """[3] of +x, -y, z, or three numbers; never of length 0."""
    if text[-1:] in _AXES and text[:-1] in ("", "+", "-"):
        return np.array(_AXES[text[-1]]) * (-1.0 if text[0] == "-" else 1.0)
    found = _vector(parsed, text)
    length = np.linalg.norm(found)
    if not 0 < length < np.inf:
        raise _wrong(parsed)
    return np.asarray(found / length)


def _vector(parsed: ParsedOperation, text: str) -> NDArray[np.float64]:
    found = regions.parse_numbers(text, 3)
    if found is None:
        raise _wrong(parsed)
    return found


def _number(parsed: ParsedOperation, low: float, high: float, whole: bool = False) -> float:
    found = regions.parse_numbers(parsed.value, 1)
    if found is None or not low <= found[0] <= high or (whole and found[0] != int(found[0])):
        raise _wrong(parsed, f" from {low:g} to {high:g}")
    return float(found[0])


def _wrong(parsed: ParsedOperation, bounds: str = "") -> SplatError:
    return SplatError(
        f"edit-{parsed.word}",
        given=f"{parsed} is not understood.",
        wanted=f"--{parsed.word} {OPERATIONS[parsed.word].takes}{bounds}.",
        hint=OPERATIONS[parsed.word].help,
        family=Family.USAGE,
    )
