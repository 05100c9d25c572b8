"""The operations of `splat edit`. All are checked before the first one runs."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages import formats
from stages.base.atomic import partial_prefix
from stages.base.errors import SplatError, UsageError
from stages.base.row_slices import row_slices
from stages.base.text import counted
from stages.editing import expression, levels, regions
from stages.editing.decimate import decimate
from stages.editing.scene import EditedScene
from stages.editing.syntax import OPERATIONS, ParsedOperation
from stages.evaluate.floaters import isolated_splats, near_camera_floaters
from stages.formats import Format
from stages.formats.values import concatenate, drop_undrawable, select_rows
from stages.raster.similarity import Similarity, rotation_about, rotation_to_up
from stages.scene import Splats

Operation = Callable[[EditedScene], EditedScene]
_AXES = {"x": (1.0, 0, 0), "y": (0, 1.0, 0), "z": (0, 0, 1.0)}
_MOST_DEGREES = 1e6  # larger numbers leave no digits for the part of a turn
_ATTEMPTS = 8  # to meet a size: one or two are enough where bytes grow with splats
_SAFETY = 0.995
# Rounding of a position shows from this share of the splat's size; few splats may show it.
_SHOWN, _FEW = 0.25, 0.01


def prepare_operations(
    parsed: Sequence[ParsedOperation], target: Path
) -> list[tuple[ParsedOperation, Operation]]:
    """Check all operations before the first one runs. target: the file to be written, which
    `max-mb` measures. Raises SplatError for wrong values and unreadable files."""
    return [(one, _prepare(one, target)) for one in parsed]


def apply_operations(
    scene: EditedScene, chain: Sequence[tuple[ParsedOperation, Operation]]
) -> Iterator[tuple[ParsedOperation, EditedScene]]:
    """Apply one operation after the other; yields each with the scene after it. Raises SplatError
    "edit-nothing-left"."""
    for parsed, operation in chain:
        before = len(scene.splats)
        scene = operation(scene)
        if before and not len(scene.splats):
            raise UsageError(
                "edit-nothing-left",
                given=f"{parsed} removes all {before:,} splats.",
                wanted="At least one splat that remains.",
                hint="`splat info` prints the bounds, sizes and opacities of a file.",
            )
        yield parsed, scene


def _prepare(parsed: ParsedOperation, target: Path) -> Operation:
    value = parsed.value
    match parsed.name:
        case "crop" | "drop" as name:
            inside, wanted = regions.parse_region(value), name == "crop"
            return _keeping(lambda splats: inside(splats.means.astype(np.float64)) == wanted)
        case "keep":
            return _keeping(expression.parse_expression(value))
        case "drop-floaters":
            return _without_floaters
        case "rotate":
            return _transforming(Similarity(rotation=_rotation(parsed)))
        case "scale":
            return _transforming(Similarity(scale=_number(parsed, 1e-9, 1e9)))
        case "move":
            return _transforming(Similarity(offset=_vector(parsed, value)))
        case "up":
            up = _direction(parsed, value)
            return _transforming(Similarity(rotation=rotation_to_up(up)))
        case "merge":
            return _merging(Path(value))
        case "degree":
            degree = int(_number(parsed, 0, 3, whole=True))
            return lambda scene: scene.with_splats(
                scene.splats.with_sh_degree(min(degree, scene.splats.sh_degree))
            )
        case "decimate":
            return _decimating(parsed)
        case "max-mb":
            return _limiting_size(_number(parsed, 1e-6, 1e9) * 1e6, target)
    raise AssertionError(parsed.name)


def _keeping(condition: Callable[[Splats], NDArray[np.bool_]]) -> Operation:
    """Keep the splats for which a condition is true; it is computed for a block at a time."""

    def kept(scene: EditedScene) -> EditedScene:
        kept_rows = np.empty(len(scene.splats), bool)
        for rows in row_slices(len(kept_rows)):
            kept_rows[rows] = condition(scene.splats.take(rows))
        return scene.reduced_to(kept_rows)

    return kept


def _transforming(similarity: Similarity) -> Operation:
    return lambda scene: scene.transformed(similarity)


def _without_floaters(scene: EditedScene) -> EditedScene:
    """Floaters by their contributions where training views are known, else isolated splats."""
    if len(scene.training_views):
        floaters = near_camera_floaters(
            scene.splats, scene.contributions(), scene.training_cameras()
        )
    else:
        floaters = isolated_splats(scene.splats)
    return scene.with_splats(select_rows(scene.splats, ~floaters))


def _merging(path: Path) -> Operation:
    formats.format_of(path)
    if not path.is_file():
        raise SplatError(
            "file-missing",
            given=f"--merge {path} does not exist.",
            wanted="A splat file.",
            hint="Check the path.",
        )

    def merged(scene: EditedScene) -> EditedScene:
        return scene.with_splats(join(scene.splats, drop_undrawable(formats.read(path))[0]))

    return merged


def join(first: Splats, second: Splats) -> Splats:
    """Both in one, in the frame and with the draw settings of `first`, at the higher SH degree.
    The origins of both are in the coordinates of the capture.

    Raises SplatError "edit-drawing-differs" if only one is to be drawn with opacity compensation,
    and "edit-merge-far" if they are so far apart that float32 rounds the second's positions.
    """
    if first.draw_settings.antialias != second.draw_settings.antialias:
        which = "second" if second.draw_settings.antialias else "first"
        raise UsageError(
            "edit-drawing-differs",
            given=f"Only the {which} of the two is for antialiased drawing.",
            wanted="Splats that are drawn in the same way: together, one half would look wrong.",
            hint="Export one of them again: splat export --drawing plain (or antialiased).",
        )
    exact = second.means + (second.origin - first.origin)
    means = exact.astype(first.means.dtype)
    _refuse_rounded(np.abs(exact - means).max(axis=1, initial=0.0), exact, second)
    both = concatenate([first, replace(second, means=means)])
    kept = {name: getattr(first, name) for name in ("origin", "place", "first_camera")}
    return replace(both, **kept, draw_settings=first.draw_settings)


def _refuse_rounded(
    errors: NDArray[np.float64], means: NDArray[np.float64], splats: Splats
) -> None:
    """Raise SplatError "edit-merge-far" if more than few of the `errors` [N] of positions show.
    means: [N, 3] in the coordinates of the first file."""
    shown = errors > _SHOWN * np.exp(splats.log_scales.max(axis=1, initial=-np.inf))
    if np.count_nonzero(shown) > _FEW * len(shown):
        raise UsageError(
            "edit-merge-far",
            given=f"The two lie {np.linalg.norm(np.median(means, axis=0)):,.0f} units apart, where "
            f"32 bits round positions by {errors.max():.2g} units.",
            wanted="Files whose coordinates have the same zero point.",
            hint="--move X,Y,Z before --merge moves the first to the second.",
        )


def _decimating(parsed: ParsedOperation) -> Operation:
    if parsed.value.endswith("%"):
        part = _number(ParsedOperation(parsed.name, parsed.value[:-1]), 1e-6, 100) / 100
        return lambda scene: scene.with_splats(
            decimate(scene.splats, round(part * len(scene.splats)))
        )
    count = int(_number(parsed, 1, 1e9, whole=True))
    return lambda scene: scene.with_splats(decimate(scene.splats, count))


def _limiting_size(max_bytes: float, target: Path) -> Operation:
    """Decimate until `target` takes at most `max_bytes`, measured on written files."""
    row = formats.format_of(target)

    def size_bytes(scene: EditedScene) -> int:
        # a dry run makes no folder for the target and may read one that it must not change
        beside = target.parent if os.access(target.parent, os.W_OK) else None
        with tempfile.TemporaryDirectory(dir=beside, prefix=partial_prefix()) as folder:
            path = Path(folder) / row.file_name("scene")
            levels.write(path, scene.splats, units=scene.units, views=scene.placed_views())
            return row.size_bytes(path)

    def limited(scene: EditedScene) -> EditedScene:
        least = size_bytes(scene.with_splats(scene.splats.take(slice(1))))
        if least > max_bytes:
            raise _too_small(max_bytes, least, 1, row)
        for attempts_left in range(_ATTEMPTS, -1, -1):
            size, count = size_bytes(scene), len(scene.splats)
            if size <= max_bytes:
                return scene
            if count == 1 or not attempts_left:
                break
            # a page takes two megabytes without its splats
            share = (max_bytes - least) / (size - least)
            fewer = 1 + int(_SAFETY * (count - 1) * share)
            scene = scene.with_splats(decimate(scene.splats, fewer))
        raise _too_small(max_bytes, size, count, row)

    return limited


def _too_small(max_bytes: float, size_bytes: int, count: int, row: Format) -> UsageError:
    return UsageError(
        "edit-too-small",
        given=f"--max-mb {max_bytes / 1e6:g} is less than {counted(count, 'splat')} "
        f"{'needs' if count == 1 else 'need'} as .{row.ending}.",
        wanted=f"At least {np.ceil(size_bytes / 1e3) / 1000:g}.",
        hint="Ask for more megabytes, or for another format.",
    )


def _rotation(parsed: ParsedOperation) -> NDArray[np.float64]:
    axis, _, degrees = parsed.value.rpartition(":")
    angle = regions.parse_numbers(degrees, 1)
    if angle is None or abs(angle[0]) > _MOST_DEGREES:
        raise _wrong(parsed)
    return rotation_about(_direction(parsed, axis), float(angle[0]))


def _direction(parsed: ParsedOperation, text: str) -> NDArray[np.float64]:
    """[3] a unit vector from +x, -y, z, or three numbers."""
    if text[-1:] in _AXES and text[:-1] in ("", "+", "-"):
        return np.array(_AXES[text[-1]]) * (-1.0 if text[0] == "-" else 1.0)
    vector = _vector(parsed, text)
    length = np.linalg.norm(vector)
    if not 0 < length < np.inf:
        raise _wrong(parsed)
    return np.asarray(vector / length)


def _vector(parsed: ParsedOperation, text: str) -> NDArray[np.float64]:
    vector = regions.parse_numbers(text, 3)
    if vector is None:
        raise _wrong(parsed)
    return vector


def _number(parsed: ParsedOperation, low: float, high: float, whole: bool = False) -> float:
    one = regions.parse_numbers(parsed.value, 1)
    if one is None or not low <= one[0] <= high or (whole and one[0] != int(one[0])):
        raise _wrong(parsed, f" from {low:g} to {high:g}")
    return float(one[0])


def _wrong(parsed: ParsedOperation, bounds: str = "") -> SplatError:
    return UsageError(
        f"edit-{parsed.name}",
        given=f"{parsed} has a value that is not understood.",
        wanted=f"--{parsed.name} {OPERATIONS[parsed.name].takes}{bounds}.",
        hint=OPERATIONS[parsed.name].help,
    )
