"""Streamed SOG: lod-meta.json and chunks of SOG in folders beside it, in the layout of PlayCanvas.

A k-d tree divides the scene into leaves. For each level of detail (0 is the finest) a leaf refers
to the rows `offset` to `offset + count` of a chunk, and a viewer loads the level that suits its
distance. We split the widest side at the median until a leaf is small enough, fill chunks with one
leaf after the other, and sort the rows of a leaf along a Morton curve.
"""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import make_folder, partial_prefix, replacing
from stages.base.bad_files import BadFileError, reading
from stages.base.blocks import reported_blocks
from stages.formats import html, sog
from stages.formats.sog_read import Source, antialias_of, in_folder, in_zip
from stages.formats.table import CHUNK
from stages.formats.values import allocate, check_finite, drop_undrawable
from stages.scene import Splats, View, morton
from stages.scene.rotations import matrices_of

LEAF, CHUNK_SPLATS = 1 << 15, 1 << 17  # splats of the finest level; of a chunk, about
_META_LIMIT_BYTES, _DEEPEST, _MOST_LEVELS = 1 << 26, 64, 100
_Rows = NDArray[np.intp]


@dataclass(frozen=True)
class _Leaf:
    """rows: of each level, in the order of the file."""

    rows: tuple[_Rows, ...]


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
) -> int:
    """Write a streamed SOG and, beside it, a page that shows it on any web server.

    Args:
        path: the asset's lod-meta.json.
        splats: the finest level.
        units: "metres" or "arbitrary".
        views: cameras of the page.
        coarser: coarser levels of detail of the same scene, finest first, all drawable.

    Returns how many of `splats` could not be drawn and were left out. Raises SplatError when the
    asset cannot be written.
    """
    kept, dropped = drop_undrawable(splats)
    write_levels(path, [kept, *coarser], units)
    html.write_beside(path, kept, units, views, splat_widths(path, kept))
    return dropped


def write_levels(path: Path, levels: Sequence[Splats], units: str) -> None:
    """Write `levels`, finest first, all drawable and in one frame. Makes the folder, replaces an
    earlier asset in it, and writes lod-meta.json last. Raises SplatError."""
    make_folder(path.parent)
    tree = _cut(levels)
    partial = path.with_name(partial_prefix() + "chunks")
    try:
        make_folder(partial)
        places = _write_chunks(partial, tree, levels, units)
        asset: dict[str, Any] = {"generator": "splat", "units": units}
        if levels[0].origin.any():
            asset["splat_origin"] = [float(v) for v in levels[0].origin]
        counts = [len(level) for level in levels]
        meta = {
            "version": 1,
            "asset": asset,
            "count": sum(counts),
            "counts": counts,
            "lodLevels": len(levels),
            "filenames": places.names,
            "tree": _described(tree, levels, places),
        }
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(meta, allow_nan=False), encoding="utf-8")
            path.unlink(missing_ok=True)  # it must never refer to other chunks
            for old in path.parent.iterdir():
                if CHUNK.match(old.name) and old.is_dir():
                    shutil.rmtree(old)
            for new in sorted(partial.iterdir()):
                new.rename(path.with_name(new.name))
    finally:
        shutil.rmtree(partial, ignore_errors=True)


@dataclass(frozen=True)
class _Places:
    """names: of the chunks. lods: by leaf and level, the location of its rows."""

    names: list[str]
    lods: dict[tuple[int, int], dict[str, int]]


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


def _write_chunks(folder: Path, tree: _Tree, levels: Sequence[Splats], units: str) -> _Places:
    places, leaves = _Places([], {}), list(_leaves(tree))
    for level, splats in enumerate(levels):
        held: list[_Rows] = []
        number = 0

        def flush(level: int = level, splats: Splats = splats) -> None:
            nonlocal held, number
            rows = np.concatenate(held)
            _write_chunk(folder / f"{level}_{number}", splats.take(rows), units)
            number, held = number + 1, []

        for index in reported_blocks(len(leaves), 1):
            rows = leaves[index.start].rows[level]
            if not len(rows):
                continue
            if not held:
                places.names.append(f"{level}_{number}/meta.json")
            before = sum(map(len, held))
            at = {"file": len(places.names) - 1, "offset": before, "count": len(rows)}
            places.lods[index.start, level] = at
            held.append(rows)
            if before + len(rows) >= CHUNK_SPLATS:
                flush()
        if held:
            flush()
    return places


def _write_chunk(folder: Path, splats: Splats, units: str) -> None:
    make_folder(folder)
    for name, content in sog.sog_members(splats, np.arange(len(splats)), units).items():
        with replacing(folder / name) as temporary:
            temporary.write_bytes(content)


def _described(tree: _Tree, levels: Sequence[Splats], places: _Places) -> dict[str, Any]:
    """The tree for lod-meta.json, with the bounding box of the ellipsoids of each node."""
    number = 0

    def node(part: _Tree) -> dict[str, Any]:
        nonlocal number
        if isinstance(part, _Leaf):
            every = range(len(levels))
            lods = {str(i): places.lods[number, i] for i in every if (number, i) in places.lods}
            number += 1
            boxes = [_box(levels[i], rows) for i, rows in enumerate(part.rows) if len(rows)]
            return {"bound": _around(boxes), "lods": lods}
        children = [node(side) for side in part]
        ends = [(c["bound"]["min"], c["bound"]["max"]) for c in children]
        return {"bound": _around(ends), "children": children}

    return node(tree)


def _box(splats: Splats, rows: _Rows) -> tuple[list[float], list[float]]:
    lows, highs = [], []
    for part in reported_blocks(len(rows)):
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
    """The finest level of each leaf, and the environment if there is one. Raises SplatError
    "splats-unreadable" for a damaged asset or a missing chunk."""
    path = Path(path)
    with reading(path):
        try:
            return check_finite(_read(path))
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
            raise BadFileError(f"one of its chunks is not a complete zip ({error})") from error


def _read(path: Path) -> Splats:
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
    places = [_place(path.parent, name) for name, _ in chunks]
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
            _fill(splats.take(slice(end, end + count)), chunk.take(slice(offset, offset + count)))
            end += count
    asset = meta.get("asset")
    origin = asset.get("splat_origin") if isinstance(asset, dict) else None
    splats = replace(splats, origin=np.array(origin or [0, 0, 0], np.float64).reshape(3))
    return splats.with_antialias(_antialias(sources))


def _antialias(sources: Sequence[Source]) -> bool:
    """Whether the chunks ask for opacity compensation. Raises BadFileError if they disagree."""
    found = {antialias_of(source.meta()) for source in sources}
    if len(found) > 1:
        raise BadFileError("its chunks disagree about antialiasing")
    return True in found


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
    found: dict[int, list[tuple[int, int]]] = {}
    for lods in _leaf_lods(tree):
        at = lods[min(lods, key=int)]
        values = [at[name] for name in ("file", "offset", "count")]
        if not all(isinstance(v, int) and 0 <= v < 1 << 40 for v in values):
            raise BadFileError("its tree refers to rows by something that is not a number")
        if values[0] >= files:
            raise BadFileError("its tree refers to a chunk that is not listed")
        found.setdefault(values[0], []).append((values[1], values[2]))
    return {file: sorted(ranges) for file, ranges in found.items()}


def parts_of(path: Path) -> dict[str, Path]:
    """By path relative to the folder: the asset and all files of its chunks. Raises SplatError
    "splats-unreadable"."""
    found = {path.name: path}
    with reading(path):
        meta = json.loads(path.read_text(encoding="utf-8"))
        for name in [*meta["filenames"], *filter(None, [meta.get("environment")])]:
            place = _place(path.parent, name)
            chunk = place.parent.iterdir() if place.name == "meta.json" else [place]
            files = (file for file in chunk if file.is_file())
            found |= {file.relative_to(path.parent).as_posix(): file for file in files}
    return found


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
    if not len(finest):
        return [0.0] * len(counts)
    width = 2 * float(np.exp(np.median(finest.log_scales.max(axis=1))))
    every: list[float] = (width * np.sqrt(counts.max() / np.maximum(counts, 1))).tolist()
    return every


def _place(folder: Path, name: Any) -> Path:
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
    degree = rest.get("bands", 0) if isinstance(rest, dict) else 0
    if rows is None:
        return degree, [(0, meta["count"])]
    end = 0
    for offset, count in rows:
        if offset < end:
            raise BadFileError("its tree refers to rows of a chunk twice")
        end = offset + count
    if end > meta["count"]:
        raise BadFileError("its tree refers to rows that a chunk does not have")
    return min(degree, 3) if isinstance(degree, int) else 0, rows


def _fill(out: Splats, values: Splats) -> None:
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        getattr(out, name)[:] = getattr(values, name)
