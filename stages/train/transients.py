"""Which parts of photographs show what moved: people, cars, leaves.

Early in a run, before it draws at full size, the model shows what photographs agree on. A part of a
photograph is transient if its mean colour differs from that of the model, and differs more than it
does in other photographs of the same surface. So what the model shows nowhere, such as fine
texture, is not transient. Nor are shadows and reflections: at least one of the connected parts
differs in more than brightness. Training stays as it is if few parts are transient (nothing moved),
if they are few of those that differ (the model is wrong), or if they are very many (a turntable:
nobody can tell what should stand still).

RobustNeRF (Sabour et al. 2023) and RobustSplat (2506.02751) compare residuals within one photograph
instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_dilation, binary_propagation

from stages.base.atomic import replacing
from stages.raster.definition import Rendering
from stages.scene import IGNORE, TRANSPARENT, Camera, evenly_spaced
from stages.seed.projection import pixel_centres, unproject
from stages.train.views import Colour, Level, target_of

FOLDER = "transients"
SHOWN = 12  # photographs on the sheet: those with most transient parts
PARTS = 24  # along the longer side of a photograph
DIFFERENT = 0.1  # length of the difference of two colours, 0..1 in each channel
OTHER_COLOUR = 0.08  # the same, after the drawing was made darker or brighter
MOST_DARKER = 0.5  # at most so much, or as much brighter
TIMES_OTHERS = 2.0  # the median difference of the other photographs
OTHER_VIEWS = 3  # other photographs that see the surface, at least
MOST_COMPARED = 48  # photographs, of many
SAME_SURFACE = 0.06  # of the depth
LEAST_SHARE = 0.005  # of all parts: fewer are chance
MOST_SHARE = 0.15  # of all parts, with their neighbours
MOSTLY = 0.5  # of the parts with another colour; else it is the model that is wrong


@dataclass(frozen=True)
class Comparison:
    """A training view and its drawing, in the same parts.

    Args:
        camera: with one pixel for each part.
        photograph: [h, w, 3] mean colours.
        drawing: [h, w, 3] mean colours.
        depth: [h, w] median depth of the drawing, world units; 0 where nothing is drawn.
    """

    camera: Camera
    photograph: NDArray[np.float32]
    drawing: NDArray[np.float32]
    depth: NDArray[np.float32]

    @classmethod
    def of(cls, level: Level, drawn: Rendering, background: Colour) -> Comparison:
        """Of a view that was drawn over `background`."""
        image = np.ascontiguousarray(drawn.image.transpose(2, 0, 1))
        target = target_of(level, image, background)
        photograph = target * np.float32(1 / 255 if target.dtype == np.uint8 else 1)
        side = max(1, min(max(drawn.depth.shape) // PARTS, *drawn.depth.shape))
        height, width = (length // side for length in drawn.depth.shape)

        def parts(picture: NDArray[np.float32]) -> NDArray[np.float32]:
            """[..., h, w, pixels of a part]"""
            inner = picture[..., : height * side, : width * side]
            blocks = inner.reshape(*inner.shape[:-2], height, side, width, side).swapaxes(-3, -2)
            return blocks.reshape(*blocks.shape[:-2], side * side)

        taken, shown = (parts(p).mean(-1).transpose(1, 2, 0) for p in (photograph, image))
        seen = level.camera
        fx, fy, cx, cy = (value / side for value in (seen.fx, seen.fy, seen.cx, seen.cy))
        camera = Camera(width, height, fx, fy, cx, cy, seen.world_to_camera)
        return cls(camera, taken, shown, np.median(parts(drawn.median_depth), axis=-1))

    @property
    def differences(self) -> NDArray[np.float32]:
        """[h, w] between the colours, apart from that of the whole photograph."""
        difference = self.photograph - self.drawing
        whole = np.median(difference.reshape(-1, 3), axis=0)
        return np.asarray(np.linalg.norm(difference - whole, axis=2), np.float32)

    @property
    def differences_in_colour(self) -> NDArray[np.float32]:
        """[h, w] between the colours, apart from brightness."""
        products = (self.photograph * self.drawing).sum(2)
        gains = products / ((self.drawing**2).sum(2) + np.float32(1e-3))
        gains = gains.clip(MOST_DARKER, 1 / MOST_DARKER)[..., None]
        return np.asarray(np.linalg.norm(self.photograph - gains * self.drawing, axis=2))


def transient_parts(views: Sequence[Comparison]) -> list[NDArray[np.bool_]]:
    """For each view [h, w] which parts are transient, with their neighbours."""
    surfaces = [_seen_by_others(view, views) for view in views]
    in_colour = [view.differences_in_colour for view in views]
    different = _unexpected([view.differences for view in views], surfaces, DIFFERENT)
    coloured = _unexpected(in_colour, surfaces, OTHER_COLOUR)
    all_coloured = float(np.mean([(errors > OTHER_COLOUR).mean() for errors in in_colour]))
    few = _share(coloured) < max(LEAST_SHARE, MOSTLY * all_coloured)
    square = np.ones((3, 3))
    connected = (
        binary_propagation(core, square, mask=core | parts)
        for core, parts in zip(coloured, different, strict=True)
    )
    found = [binary_dilation(parts, square) for parts in connected]
    if few or _share(found) > MOST_SHARE:
        return [np.zeros_like(parts) for parts in found]
    return found


def _share(parts: Sequence[NDArray[np.bool_]]) -> float:
    return float(np.mean([view.mean() for view in parts]))


def without(level: Level, parts: NDArray[np.bool_]) -> Level:
    """The view with `parts` [h, w] of it ignored, too; as it is if it is cut out."""
    if not parts.any() or level.outside == TRANSPARENT:
        return level
    size = level.camera.width, level.camera.height
    kept = cv2.resize(np.uint8(255) * ~parts, size, interpolation=cv2.INTER_NEAREST_EXACT)
    mask = kept if level.mask is None else np.minimum(kept, level.mask)
    return replace(level, mask=np.asarray(mask, np.uint8), outside=IGNORE)


def save_masks(
    folder: Path, names: Sequence[str], levels: Iterable[Level], parts: Sequence[NDArray[np.bool_]]
) -> dict[str, Path]:
    """Write the masks of the views that have transient parts into `folder`; the file by the name of
    the photograph. Raises OSError if the disk is full."""
    files = {}
    for number, (name, level, transient) in enumerate(zip(names, levels, parts, strict=True)):
        if level.mask is not None and level.outside == IGNORE and transient.any():
            files[name] = _write_mask(folder, number, level.mask)
    return files


def join_masks(folder: Path, found: Iterable[Mapping[str, Path]]) -> dict[str, Path]:
    """Write masks of the same photographs, by name, into `folder`, each as one: what all of them
    keep. Masks of a photograph have one size. Raises OSError if the disk is full."""
    by_name: dict[str, list[Path]] = {}
    for masks in found:
        for name, path in masks.items():
            by_name.setdefault(name, []).append(path)
    return {
        name: _write_mask(folder, number, np.minimum.reduce([_read_mask(path) for path in paths]))
        for number, (name, paths) in enumerate(sorted(by_name.items()))
    }


def _write_mask(folder: Path, number: int, mask: NDArray[np.uint8]) -> Path:
    path = folder / FOLDER / f"{number:04d}.png"
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as temporary:
        Image.fromarray(mask).save(temporary, format="PNG")
    return path


def _read_mask(path: Path) -> NDArray[np.uint8]:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("L"))


def _seen_by_others(view: Comparison, views: Sequence[Comparison]) -> dict[int, NDArray[np.intp]]:
    """Where other views see the surface of each part, by their number: the index into their parts,
    flattened [h * w]; -1 where they do not."""
    rows, columns = (index.ravel() for index in np.indices(view.depth.shape))
    depths = view.depth.ravel().astype(np.float64)
    points = unproject(view.camera, pixel_centres(rows, columns), depths)
    seen = {}
    for number in evenly_spaced(range(len(views)), MOST_COMPARED):
        other = views[number]
        if other is view:
            continue
        pixels, z = other.camera.project(points)
        shown = np.flatnonzero((depths > 0) & (z > 0) & other.camera.shows(pixels))
        x, y = pixels[shown].astype(np.intp).T
        same = np.abs(other.depth[y, x] - z[shown]) < SAME_SURFACE * z[shown]
        seen[number] = np.full(len(points), -1)
        seen[number][shown[same]] = (y * other.camera.width + x)[same]
    return seen


def _unexpected(
    errors: Sequence[NDArray[np.float32]],
    surfaces: Sequence[dict[int, NDArray[np.intp]]],
    least: float,
) -> list[NDArray[np.bool_]]:
    """[h, w] for each view: whether the error of a part is at least `least`, and TIMES_OTHERS the
    median of its surface's in OTHER_VIEWS other views or more."""
    found = []
    for own, seen in zip(errors, surfaces, strict=True):
        others = np.full((max(1, len(seen)), own.size), np.nan, np.float32)
        for row, (number, at) in zip(others, seen.items(), strict=False):
            row[at >= 0] = errors[number].ravel()[at[at >= 0]]
        enough = np.isfinite(others).sum(axis=0) >= OTHER_VIEWS
        expected = np.full(own.size, np.inf, np.float32)
        if enough.any():
            expected[enough] = np.nanmedian(others[:, enough], axis=0)
        found.append((own > least) & (own > TIMES_OTHERS * expected.reshape(own.shape)))
    return found
