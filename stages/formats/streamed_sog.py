"""Streamed SOG: lod-meta.json and chunks of SOG in folders beside it, in the layout of PlayCanvas.

A k-d tree divides the scene into leaves. For each level of detail (0 is the finest) a leaf refers
to the rows `offset` to `offset + count` of a chunk, and a viewer loads the level that suits its
distance. We split the widest side at the median until a leaf is small enough, fill chunks with one
leaf after the other, and sort the rows of a leaf along a Morton curve.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stages.base.atomic import make_folder, replacing, temporary_beside
from stages.base.bad_files import BadFileError, reading
from stages.base.errors import UsageError
from stages.base.row_slices import row_slices
from stages.formats import html, sog
from stages.formats.json_fields import agreed, located, location_fields, whole
from stages.formats.sog_read import Source, antialias_of, in_folder, in_zip
from stages.formats.values import allocate, fill
from stages.scene import Splats, View, morton
from stages.scene.rotations import matrices_of

LEAF, CHUNK_SPLATS = 1 << 15, 1 << 17  # splats of the finest level; of a chunk, about
_META_LIMIT_BYTES, _DEEPEST, _MOST_LEVELS = 1 << 26, 64, 100
_CHUNK = re.compile(r"([0-9]+_[0-9]+)/meta\.json")  # as `_write_chunks` names them: level, number
_CHUNK_FILES = (
    *("meta.json", "means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"),
    *("shN_centroids.webp", "shN_labels.webp"),
)
_OF_PAGE = b'"content": "lod-meta.json"'  # in the data of the asset's page
_Rows = NDArray[np.intp]


@dataclass(frozen=True)
class _Leaf:
    """rows: of each level, in the order of the file. lods: by level, where the rows are."""

    rows: tuple[_Rows, ...]
    lods: dict[str, dict[str, int]] = field(default_factory=dict)


_Tree = _Leaf | tuple["_Tree", "_Tree"]


def order(splats: Splats) -> NDArray[np.intp]:
    """[N] rows of the finest level as `read` finds them."""
    leaves = [leaf.rows[0] for leaf in _leaves(_cut([splats]))]
    return np.concatenate(leaves) if leaves else np.zeros(0, np.intp)


def write(
    path: Path,
    splats: Splats,
    *,
    units: str = "arbitrary",
    views: tuple[View, ...] = (),
    coarser: Sequence[Splats] = (),
) -> None:
    """Write a streamed SOG and, beside it, a page that shows it on any web server. Makes the
    folder. The chunks get names that nothing has, then lod-meta.json replaces that of an earlier
    asset, so that one of the two is whole at any time. Of the earlier asset only files of SOG in
    the folders that its lod-meta.json names are removed.

    Args:
        path: the asset's lod-meta.json.
        splats: the finest level.
        units: "metres" or "arbitrary".
        views: cameras of the page.
        coarser: coarser levels of detail of the same scene, finest first, all drawable.

    Raises SplatError when the asset cannot be written, and "lod-folder-taken" if a page of another
    kind has the name of the asset's.
    """
    _refuse_taken(path.with_suffix(".html"))
    levels = [splats, *coarser]
    make_folder(path.parent)
    tree = _cut(levels)
    with temporary_beside(path) as asset:
        names = _write_chunks(asset.parent, list(_leaves(tree)), levels, units)
        meta = _meta(tree, levels, names, units)
        asset.write_text(json.dumps(meta, allow_nan=False), encoding="utf-8")
        html.write_beside(asset, splats, units, views, splat_widths(asset, splats))
        move(asset, path)


def move(asset: Path, path: Path) -> None:
    """Move a new asset to `path`; see `write`. Raises SplatError as it does."""
    _refuse_taken(path.with_suffix(".html"))
    meta, earlier = json.loads(asset.read_text(encoding="utf-8")), _chunk_folders(path)
    folders = _free_folders(path, meta["filenames"])
    try:
        with replacing(path) as temporary:
            names = [f"{folder.name}/meta.json" for folder in folders]
            moved = json.dumps(meta | {"filenames": names}, allow_nan=False)
            temporary.write_text(moved, encoding="utf-8")
            for name, folder in zip(meta["filenames"], folders, strict=True):
                (asset.parent / name).parent.rename(folder)
    except BaseException:
        for folder in set(folders) - _chunk_folders(path):
            shutil.rmtree(folder, ignore_errors=True)
        raise
    for old in earlier:
        _remove_chunk(old)
    os.replace(asset.with_suffix(".html"), path.with_suffix(".html"))


def _meta(tree: _Tree, levels: Sequence[Splats], names: list[str], units: str) -> dict[str, Any]:
    """The content of lod-meta.json. names: of the chunks."""
    counts = [len(level) for level in levels]
    finest = levels[0]
    asset = {"generator": "splat", "units": units}
    return {
        "version": 1,
        "asset": asset | location_fields(finest.origin, finest.place),
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
        "filenames": names,
        "tree": _described(tree, levels),
    }


def _chunk_folders(path: Path) -> set[Path]:
    """The folders of chunks of the asset at `path`, by its own list. A file that is no list of
    chunks names none: whatever lies beside it may be the user's."""
    try:
        names = json.loads(path.read_text(encoding="utf-8"))["filenames"]
        found = filter(None, (_CHUNK.fullmatch(name) for name in names))
        folders = {path.with_name(match[1]) for match in found}
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return set()
    return {folder for folder in folders if folder.is_dir() and not folder.is_symlink()}


def _refuse_taken(page: Path) -> None:
    """Raise SplatError "lod-folder-taken" if `page` exists and is not the page of an asset."""
    if page.is_file() and _OF_PAGE not in page.read_bytes():
        raise UsageError(
            "lod-folder-taken",
            given=f"{page} exists and is not the page of an asset.",
            wanted="A folder in which the files of the asset overwrite nothing.",
            hint="Name another, empty folder.",
        )


def _free_folders(path: Path, names: Sequence[str]) -> list[Path]:
    """A folder beside `path` for each of the chunks `names`: with the same number added to all, so
    that nothing has their names."""
    for first in itertools.count():
        parts = (name.partition("/")[0].split("_") for name in names)
        folders = [path.with_name(f"{level}_{int(number) + first}") for level, number in parts]
        if not any(os.path.lexists(folder) for folder in folders):
            return folders
    raise AssertionError


def _remove_chunk(folder: Path) -> None:
    """Remove the files of a SOG, and the folder if nothing else is in it."""
    for name in _CHUNK_FILES:
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def _cut(levels: Sequence[Splats]) -> _Tree:
    """The tree of all levels, divided at the medians of the finest."""

    def node(rows: list[_Rows], depth: int) -> _Tree:
        means = levels[0].means[rows[0]]
        if len(means) > LEAF and depth < _DEEPEST:
            axis = int(np.ptp(means, axis=0).argmax())
            plane = np.median(means[:, axis])
            sides = [levels[i].means[part, axis] < plane for i, part in enumerate(rows)]
            if 0 < sides[0].sum() < len(means):
                below = [part[side] for part, side in zip(rows, sides, strict=True)]
                above = [part[~side] for part, side in zip(rows, sides, strict=True)]
                return node(below, depth + 1), node(above, depth + 1)
        curves = (morton.morton_order_of(levels[i].means[part]) for i, part in enumerate(rows))
        return _Leaf(tuple(part[curve] for part, curve in zip(rows, curves, strict=True)))

    return node([np.arange(len(level)) for level in levels], 0)


def _leaves(tree: _Tree) -> Iterator[_Leaf]:
    if isinstance(tree, _Leaf):
        yield tree
        return
    for side in tree:
        yield from _leaves(side)


def _write_chunks(
    folder: Path, leaves: list[_Leaf], levels: Sequence[Splats], units: str
) -> list[str]:
    """Write the chunks and fill `lods` of the leaves; returns the names of the chunks."""
    names: list[str] = []
    for level, splats in enumerate(levels):
        used = [leaf for leaf in leaves if len(leaf.rows[level])]
        held: list[_Rows] = []
        first = len(names)
        for index in row_slices(len(used), 1):
            if not held:
                names.append(f"{level}_{len(names) - first}/meta.json")
            leaf, before = used[index.start], sum(map(len, held))
            held.append(leaf.rows[level])
            count = len(leaf.rows[level])
            leaf.lods[str(level)] = {"file": len(names) - 1, "offset": before, "count": count}
            if before + count >= CHUNK_SPLATS or index.stop == len(used):
                rows = np.concatenate(held)
                _write_chunk((folder / names[-1]).parent, splats.take(rows), units)
                held = []
    return names


def _write_chunk(folder: Path, splats: Splats, units: str) -> None:
    make_folder(folder)
    for name, content in sog.sog_members(splats, np.arange(len(splats)), units).items():
        with replacing(folder / name) as temporary:
            temporary.write_bytes(content)


def _described(part: _Tree, levels: Sequence[Splats]) -> dict[str, Any]:
    """The tree for lod-meta.json, with the bounding box of the ellipsoids of each node."""
    if isinstance(part, _Leaf):
        boxes = [_bounding_box(levels[i], rows) for i, rows in enumerate(part.rows) if len(rows)]
        return {"bound": _around(boxes), "lods": part.lods}
    children = [_described(side, levels) for side in part]
    ends = [(c["bound"]["min"], c["bound"]["max"]) for c in children]
    return {"bound": _around(ends), "children": children}


def _bounding_box(splats: Splats, rows: _Rows) -> tuple[list[float], list[float]]:
    """(low, high) of the ellipsoids of some rows, one standard deviation along each axis: the
    boxes that splat-transform writes (its write-lod.ts)."""
    lows, highs = [], []
    for part in row_slices(len(rows)):
        some = rows[part]
        sizes = np.exp(splats.log_scales[some].astype(np.float64))
        reach = (np.abs(matrices_of(splats.quaternions[some])) * sizes[:, None, :]).sum(axis=2)
        lows.append((splats.means[some] - reach).min(axis=0))
        highs.append((splats.means[some] + reach).max(axis=0))
    return np.min(lows, axis=0).tolist(), np.max(highs, axis=0).tolist()


def _around(boxes: Sequence[tuple[list[float], list[float]]]) -> dict[str, list[float]]:
    if not boxes:
        return {"min": [0.0, 0.0, 0.0], "max": [0.0, 0.0, 0.0]}
    lows, highs = zip(*boxes, strict=True)
    return {"min": np.min(lows, axis=0).tolist(), "max": np.max(highs, axis=0).tolist()}


def read(path: Path) -> Splats:
    """The finest level of each leaf, and the environment if there is one. Raises BadFileError for a
    damaged asset or a missing chunk."""
    if path.stat().st_size > _META_LIMIT_BYTES:
        raise BadFileError("it is too large for a list of chunks")
    meta = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(meta, dict) or meta.get("version", 1) != 1:
        raise BadFileError("it is not a lod-meta.json of version 1")
    names = meta.get("filenames")
    if not isinstance(names, list) or not isinstance(meta.get("tree"), dict):
        raise BadFileError("it lacks filenames or a tree")
    rows = _finest(meta["tree"], len(names))
    chunks: list[tuple[Any, list[tuple[int, int]] | None]]
    chunks = [(names[file], wanted) for file, wanted in sorted(rows.items())]
    if meta.get("environment"):
        chunks.append((meta["environment"], None))
    places = [beside(path.parent, name) for name, _ in chunks]
    if len(set(places)) < len(places):
        raise BadFileError("it names a chunk twice")
    sources = [_source(place) for place in places]
    ranges = [_checked(source, wanted) for source, (_, wanted) in zip(sources, chunks, strict=True)]
    degree = max((found for found, _ in ranges), default=0)
    splats = allocate(sum(n for _, each in ranges for _, n in each), degree)
    end = 0
    for source, (_, each) in zip(sources, ranges, strict=True):
        chunk = source.splats().with_sh_degree(degree)
        for offset, count in each:
            fill(splats.take(slice(end, end + count)), chunk.take(slice(offset, offset + count)))
            end += count
    splats = located(splats, meta.get("asset"))
    said = (antialias_of(source.meta()) for source in sources)
    return splats.with_antialias(agreed(said, "its chunks disagree about antialiasing"))


def _leaf_lods(tree: Any) -> Iterator[dict[str, Any]]:
    """By level, the rows of each leaf. Raises BadFileError for what is no tree."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if not isinstance(node, dict):
            raise BadFileError("its tree holds an entry that is not a node")
        children, lods = node.get("children"), node.get("lods")
        if isinstance(lods, dict) and lods:
            yield lods
        elif isinstance(children, list):
            waiting += children


def _finest(tree: dict[str, Any], files: int) -> dict[int, list[tuple[int, int]]]:
    """By chunk: (offset, count) of its rows in the finest level, ascending."""
    rows_of: dict[int, list[tuple[int, int]]] = {}
    for lods in _leaf_lods(tree):
        at = lods[min(lods, key=int)]
        file = whole(at, "file", most=files - 1)
        rows_of.setdefault(file, []).append((whole(at, "offset"), whole(at, "count")))
    return {file: sorted(ranges) for file, ranges in rows_of.items()}


def parts_of(path: Path) -> dict[str, Path]:
    """By path relative to the folder: the asset and all files of its chunks. Raises SplatError
    "splats-unreadable"."""
    parts = {path.name: path}
    with reading(path):
        meta = json.loads(path.read_text(encoding="utf-8"))
        for name in [*meta["filenames"], *filter(None, [meta.get("environment")])]:
            place = beside(path.parent, name)
            chunk = place.parent.iterdir() if place.name == "meta.json" else [place]
            files = (file for file in chunk if file.is_file())
            parts |= {file.relative_to(path.parent).as_posix(): file for file in files}
    return parts


def splat_widths(path: Path, finest: Splats) -> list[float]:
    """The width of the splats of each level in world units: two median standard deviations of the
    finest level, scaled by the square root of the ratio of counts. Raises SplatError."""
    with reading(path):
        meta = json.loads(path.read_text(encoding="utf-8"))
        if not 0 <= meta["lodLevels"] <= _MOST_LEVELS:
            raise BadFileError(f"it has more than {_MOST_LEVELS} levels")
        counts = np.zeros(meta["lodLevels"])
        for lods in _leaf_lods(meta["tree"]):
            for level, at in lods.items():
                counts[int(level)] += at["count"]
    return level_widths(counts, finest)


def level_widths(counts: ArrayLike, finest: Splats) -> list[float]:
    """As `splat_widths`, of levels with these numbers of splats."""
    counts = np.asarray(counts, np.float64)
    if not len(finest):
        return [0.0] * len(counts)
    width = 2 * float(np.exp(np.median(finest.log_scales.max(axis=1))))
    every: list[float] = (width * np.sqrt(counts.max() / np.maximum(counts, 1))).tolist()
    return every


def beside(folder: Path, name: Any) -> Path:
    """The file of this name in the folder or below it. Raises BadFileError."""
    parts = PurePosixPath(name).parts if isinstance(name, str) else ("..",)
    place = folder.joinpath(*parts)
    if ".." in parts or PurePosixPath(name).is_absolute() or not place.is_file():
        raise BadFileError(f"its chunk {str(name)[:80]!r} is not beside it")
    return place


def _source(place: Path) -> Source:
    """A chunk: a folder's meta.json, or a .sog."""
    if place.name == "meta.json":
        files = [file for file in place.parent.iterdir() if file.is_file()]
        return Source(in_folder(place.parent), sum(file.stat().st_size for file in files))
    return Source(in_zip(zipfile.ZipFile(place)), place.stat().st_size)


def _checked(
    source: Source, rows: list[tuple[int, int]] | None
) -> tuple[int, list[tuple[int, int]]]:
    """(SH degree, rows) of a chunk, checked for overlaps; None stands for all rows."""
    meta = source.meta()
    rest = meta.get("shN")
    degree = whole(rest, "bands", 0, most=3) if isinstance(rest, dict) else 0
    if rows is None:
        return degree, [(0, meta["count"])]
    end = 0
    for offset, count in rows:
        if offset < end:
            raise BadFileError("its tree refers to rows of a chunk twice")
        end = offset + count
    if end > meta["count"]:
        raise BadFileError("its tree refers to rows that a chunk does not have")
    return degree, rows
