"""3D Tiles 1.1: tileset.json, and .glb of SPZ in a folder beside it, placed on the earth.

A tile holds the splats of one level of detail in a box. Its four children hold the next finer level
in quarters of the box, and replace it: all tiles have about as many splats.
CesiumJS 1.145 takes splats in tiles only where they are compressed, and where the tileset requires
the extensions of `gltf_spz`. Specification: OGC 22-025r4.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import make_folder, replacing, temporary_beside
from stages.base.bad_files import BadFileError, reading
from stages.base.distribution import VERSION
from stages.formats import gltf_read, gltf_spz
from stages.formats.earth_fixed import earth_from_place
from stages.formats.gltf_file import EXTENSION, SPZ_EXTENSION
from stages.formats.json_fields import agreed, located, location_fields
from stages.formats.streamed_sog import beside, level_widths
from stages.formats.values import concatenate
from stages.raster.definition import ALPHA_MIN
from stages.scene import Splats
from stages.scene.flip import flipped
from stages.scene.rotations import matrices_of

# Viewers refine a tile whose geometric error is wider than 16 pixels, if nobody sets another
# number. Here that is where its splats are wider than 4: CesiumJS does not widen splats, leaves out
# those below 0.7 pixels, and so draws a coarser level better.
_USUAL_PIXELS, _WIDEST_PIXELS = 16, 4
# From our axes to those of a tileset: x, then what glTF has along -z, then up.
_FROM_OURS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_META_LIMIT_BYTES = 1 << 26
TILE_SPLATS, _DEEPEST = 20_000, 32  # of a tile, about; of the tree
_FOLDER, _TILE = "tiles_0", re.compile(r"(tiles_[0-9]+)/[0-9]+_[0-9]+\.glb")
_Rows = NDArray[np.intp]
_Ends = tuple[NDArray[np.float64], NDArray[np.float64]]  # (low, high) of a box along the axes


@dataclass(frozen=True)
class _Tile:
    """rows: of the level that it holds; none where it only divides. children: in its quarters."""

    level: int
    rows: _Rows
    name: str
    children: tuple[_Tile, ...]


def order(splats: Splats) -> NDArray[np.intp]:
    """[N] rows of the finest level as `read` finds them."""
    leaves = [tile.rows for tile in _every(_divided([splats])) if not tile.children]
    return np.concatenate(leaves)


def write(
    path: Path, splats: Splats, *, units: str = "arbitrary", coarser: Sequence[Splats] = ()
) -> None:
    """Write a tileset. Makes the folder. The tiles get a folder of a name that nothing has, then
    tileset.json replaces that of an earlier asset, and its tiles are removed.

    Args:
        path: the asset's tileset.json.
        splats: the finest level.
        units: "metres" or "arbitrary".
        coarser: coarser levels of detail of the same scene, finest first, all drawable.

    Raises SplatError when the asset cannot be written, or its system needs a missing library.
    """
    levels = [splats, *coarser]
    root = _divided(levels)
    transform = _transform(splats)
    make_folder(path.parent)
    with temporary_beside(path) as asset:
        boxes: dict[str, _Ends] = {}
        for tile in _every(root):
            if len(tile.rows):
                make_folder(asset.parent / _FOLDER)
                held = levels[tile.level].take(tile.rows)
                held = replace(held, origin=np.zeros(3), place=None, first_camera=None)
                rounded = gltf_spz.write_rounded(asset.parent / tile.name, held, units=units)
                boxes[tile.name] = _drawn_box(rounded)
        content = _described(levels, root, boxes, transform, units)
        asset.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
        move(asset, path)


def move(asset: Path, path: Path) -> None:
    """Move a new asset to `path`; see `write`. Raises SplatError when that fails."""
    earlier = _own_folder(path)
    folder = next(
        free
        for number in itertools.count()
        if not os.path.lexists(free := path.with_name(f"tiles_{number}"))
    )
    text = asset.read_text(encoding="utf-8").replace(f'"{_FOLDER}/', f'"{folder.name}/')
    try:
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
            if (tiles := asset.parent / _FOLDER).is_dir():
                tiles.rename(folder)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    if earlier:
        for tile in earlier.glob("[0-9]*_[0-9]*.glb"):
            tile.unlink()
        if not any(earlier.iterdir()):
            earlier.rmdir()


def _own_folder(path: Path) -> Path | None:
    """The folder of tiles of the asset at `path`, if all that it names lies there."""
    try:
        tiles = list(_contents(json.loads(path.read_text(encoding="utf-8"))["root"]))
        names = {match[1] if (match := _TILE.fullmatch(name)) else "" for name in tiles}
    except (OSError, ValueError, LookupError, TypeError, BadFileError):
        return None
    folder = path.with_name(names.pop() or ".") if len(names) == 1 else path
    return folder if folder.is_dir() and not folder.is_symlink() else None


def _divided(levels: Sequence[Splats]) -> _Tile:
    """The tree of all levels. The widest side is divided at the median of the finest, twice for
    each level."""
    numbers = itertools.count()

    def tile(rows: list[_Rows], depth: int) -> _Tile:
        parts = [part for half in _halves(levels, rows) for part in _halves(levels, half)]
        parts = [part for part in parts if len(part[0])]
        leaf = len(rows[0]) <= TILE_SPLATS or depth == _DEEPEST or len(parts) < 2
        level = 0 if leaf else max(len(levels) - 1 - depth, 0)
        held = rows[level] if leaf or level else rows[0][:0]
        name = f"{_FOLDER}/{level}_{next(numbers)}.glb"
        children = () if leaf else tuple(tile(part, depth + 1) for part in parts)
        return _Tile(level, held, name, children)

    return tile([np.arange(len(level)) for level in levels], 0)


def _halves(levels: Sequence[Splats], rows: list[_Rows]) -> list[list[_Rows]]:
    """The rows of each level on either side of the finest's median."""
    means = levels[0].means[rows[0]]
    if not len(means):
        return []
    axis = int(np.ptp(means, axis=0).argmax())
    plane = np.median(means[:, axis])
    sides = [levels[i].means[part, axis] < plane for i, part in enumerate(rows)]
    pairs = list(zip(rows, sides, strict=True))
    return [[part[side] for part, side in pairs], [part[~side] for part, side in pairs]]


def _every(tile: _Tile) -> Iterator[_Tile]:
    yield tile
    for child in tile.children:
        yield from _every(child)


def _described(
    levels: Sequence[Splats],
    root: _Tile,
    boxes: dict[str, _Ends],
    transform: NDArray[np.float64] | None,
    units: str,
) -> dict[str, Any]:
    """The content of tileset.json. boxes: of the contents of tiles, by name. transform: of the
    root."""
    finest = levels[0]
    said = flipped(finest.take(slice(0)))
    extensions = [EXTENSION, SPZ_EXTENSION]
    widths = level_widths([len(level) for level in levels], finest)
    errors = [_USUAL_PIXELS / _WIDEST_PIXELS * width for width in widths]
    # so that a viewer leaves the scene out where it is smaller than a pixel
    sides = np.ptp(finest.means.astype(np.float64), axis=0) if len(finest) else np.zeros(3)
    whole = max(_USUAL_PIXELS * float(np.linalg.norm(sides)), *errors)
    described = _described_tile(root, boxes, errors, whole) | {"refine": "REPLACE"}
    if transform is not None:
        described["transform"] = transform.T.ravel().tolist()
    return {
        "asset": {
            "version": "1.1",
            "generator": f"splat {VERSION}",
            "extras": {"units": units, **location_fields(said.origin, said.place)},
        },
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {
            "3DTILES_content_gltf": {
                "extensionsUsed": extensions,
                "extensionsRequired": extensions,
            }
        },
        "geometricError": whole,
        "root": described,
    }


def _described_tile(
    tile: _Tile, boxes: dict[str, _Ends], errors: Sequence[float], above: float
) -> dict[str, Any]:
    """errors: of the levels. above: that of the tile that this one replaces."""
    error = 0.0 if not tile.children else errors[tile.level] if len(tile.rows) else above
    children = [_described_tile(child, boxes, errors, error) for child in tile.children]
    ends = [_ends(child["boundingVolume"]["box"]) for child in children]
    if len(tile.rows):
        ends.append(boxes[tile.name])
    low = np.min([end[0] for end in ends], axis=0) if ends else np.zeros(3)
    high = np.max([end[1] for end in ends], axis=0) if ends else np.zeros(3)
    sides = np.diag((high - low) / 2)
    described: dict[str, Any] = {
        "boundingVolume": {"box": [*((low + high) / 2).tolist(), *sides.ravel().tolist()]},
        "geometricError": error,
    }
    if len(tile.rows):
        described["content"] = {"uri": tile.name}
    if children:
        described["children"] = children
    return described


def _drawn_box(held: Splats) -> _Ends:
    """Around what is drawn of the splats of a tile: each to where its alpha is `ALPHA_MIN`.
    A bounding volume encloses its content (OGC 22-025r4, 3D Tiles 1.1)."""
    axes = matrices_of(held.quaternions) * np.exp(held.log_scales.astype(np.float64))[:, None, :]
    deviations = np.linalg.norm(axes, axis=2)
    fades = np.maximum(held.opacities.astype(np.float64) / ALPHA_MIN, 1)  # until it is not drawn
    reach = deviations * np.sqrt(2 * np.log(fades))[:, None]
    ends = [(held.means - reach).min(axis=0), (held.means + reach).max(axis=0)]
    box = np.array(ends) @ _FROM_OURS.T
    return box.min(axis=0), box.max(axis=0)


def _ends(box: Sequence[float]) -> _Ends:
    """(low, high) of a box along the axes."""
    middle, half = np.array(box[:3]), np.diag(np.reshape(box[3:], (3, 3)))
    return middle - half, middle + half


def _transform(splats: Splats) -> NDArray[np.float64] | None:
    """[4, 4] from the tileset to the earth-centred, earth-fixed frame; to a local frame where the
    place is not known, None if that is the tileset's own."""
    matrix = np.eye(4)
    if splats.place is not None:
        turn, offset = earth_from_place(splats.place.beside(splats.origin))
        matrix[:3, :3], matrix[:3, 3] = turn @ _FROM_OURS.T, offset
        return matrix
    matrix[:3, 3] = _FROM_OURS @ splats.origin
    return matrix if splats.origin.any() else None


def read(path: Path) -> Splats:
    """The splats of the finest tiles, y down, in the frame of the root. Raises BadFileError for a
    damaged or an unsupported asset: tiles that are placed by themselves, other tilesets as content,
    implicit tiles."""
    meta = _meta(path)
    places = [beside(path.parent, name) for name in _contents(meta["root"])]
    if len(set(places)) < len(places):  # which bounds the memory
        raise BadFileError("it names a tile twice")
    parts = [gltf_read.read(place) for place in places]
    origin = parts[0].origin if parts else np.zeros(3)
    moved = [
        replace(part, means=(part.means + (part.origin - origin)).astype(np.float32))
        for part in parts
    ]
    said = (part.draw_settings.antialias for part in parts)
    splats = concatenate(moved).with_antialias(agreed(said, "its tiles disagree about drawing"))
    place = flipped(located(splats.take(slice(0)), meta["asset"].get("extras")))
    return replace(splats, origin=place.origin + origin, place=place.place)


def _meta(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _META_LIMIT_BYTES:
        raise BadFileError("it is too large for a list of tiles")
    meta = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(meta, dict) or not isinstance(meta.get("asset"), dict):
        raise BadFileError("it is not a tileset")
    if not isinstance(meta.get("root"), dict):
        raise BadFileError("it has no root")
    return meta


def _contents(root: Any, every: bool = False) -> Iterator[str]:
    """The names of the finest tiles, or of `every` tile. Raises BadFileError."""
    waiting = [(root, True, False)]
    while waiting:
        tile, top, adds = waiting.pop()
        if not isinstance(tile, dict) or "implicitTiling" in tile or "contents" in tile:
            raise BadFileError("it has tiles of a kind that is not supported")
        moved = np.array(tile.get("transform", np.eye(4).ravel().tolist()), np.float64)
        if not top and not np.array_equal(moved, np.eye(4).ravel()):
            raise BadFileError("its tiles are placed by themselves, which is not supported")
        adds = tile.get("refine", "ADD" if adds else "REPLACE") == "ADD"
        children = tile.get("children", [])
        if content := tile.get("content"):
            name = content.get("uri") if isinstance(content, dict) else None
            if not isinstance(name, str) or not name.lower().endswith((".glb", ".gltf")):
                raise BadFileError(f"its tile {str(name)[:80]!r} is not glTF")
            if every or adds or not children:
                yield name
        if not isinstance(children, list):
            raise BadFileError("the children of a tile are not a list")
        waiting += [(child, False, adds) for child in reversed(children)]


def parts_of(path: Path) -> dict[str, Path]:
    """By path relative to the folder: the asset and all its tiles. Raises SplatError
    "splats-unreadable"."""
    with reading(path):
        names = _contents(_meta(path)["root"], every=True)
        return {path.name: path} | {name: beside(path.parent, name) for name in names}
