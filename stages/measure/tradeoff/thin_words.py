"""Where the capture is thin, in sentences: places by the photographs' names, and where to stand."""

from __future__ import annotations

from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from stages.base.text import counted
from stages.measure.coverage import FEW_PHOTOGRAPHS, SMALL_ANGLE_DEG, Around, Gap, Place
from stages.measure.tradeoff.curves import Trade
from stages.measure.tradeoff.thin import Thin

_OVERHEAD_DEG, _DOWN_DEG = 65.0, 25.0
_SAME_HEADING_DEG = 20.0
_SAME_HEIGHT_DEG = 10.0
_FEW_SHARE = 0.01  # of what is seen: a smaller place is not worth a word
_SIDE_WORDS = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)
_LOSS_DB = 0.5  # of pictures drawn small, against those scaled down


def about_coverage(trade: Trade) -> list[str]:
    """What photographs see too little of, and from where one more would help most."""
    thin = trade.thin
    if thin.ring is None:
        return ["No photograph of training shows any splat."]
    patches = thin.patches
    share = float(patches.area[patches.thin].sum() / patches.area.sum())
    told = [
        f"Of the surfaces that photographs show, {share:.0%} are thin: seen by fewer than "
        f"{FEW_PHOTOGRAPHS} of the {len(thin.names)} that training saw, or from directions less "
        f"than {SMALL_ANGLE_DEG:g}° apart. Half are seen by "
        f"{counted(patches.median_count, 'photograph')} or more."
    ]
    told += [_gap(thin, thin.ring, number, gap) for number, gap in enumerate(thin.gaps, 1)]
    if not thin.gaps:
        told.append("No side from which one could look is far from every photograph.")
    places = [place for place in thin.places if place.share >= _FEW_SHARE]
    told += [_place(thin, letter, place) for letter, place in zip("abc", places, strict=False)]
    return [*told, _floaters(thin)]


def about_framing(trade: Trade) -> list[str]:
    """What becomes of the picture away from the photographs' own distance and size."""
    own, *others = trade.thin.framings
    drawn, scaled = trade.thin.small_psnr_db
    most = max(others, key=lambda framing: framing.shimmer)
    told = [
        f"Shimmer, what is left of a step of half a pixel between frames once even motion is taken "
        f"off: {own.shimmer:.1f} of 255 {own.label}, and most {most.label}: {most.shimmer:.1f}."
    ]
    told.append(
        f"With a quarter of the pixels a side, held-out photographs come to {drawn:.2f} dB; drawn "
        f"whole and then scaled down, to {scaled:.2f} dB."
    )
    if scaled - drawn > _LOSS_DB:
        told.append(
            "Splats thicken where pixels are large. For pictures that small, or from far away, "
            "draw large and scale down."
        )
    return told


def side_of(thin: Thin, ring: Around, direction: NDArray[np.float64]) -> str:
    """A direction around the middle in words: beside, between or opposite which photographs.

    direction [3]: unit, as in `Around`."""
    height = float(ring.heights_deg(direction))
    if ring.inward and height > _OVERHEAD_DEG:
        return "straight above"
    turns = (ring.headings_deg(ring.directions) - ring.headings_deg(direction)) % 360
    after, before = int(turns.argmin()), int(turns.argmax())
    away = min(float(turns[after]), 360 - float(turns[before]))
    near = after if turns[after] <= 360 - turns[before] else before
    hole = float(turns[after] + 360 - turns[before])
    if away <= _SAME_HEADING_DEG:
        over = height - float(ring.heights_deg(ring.directions[near]))
        where = f"{'above' if over > 0 else 'below'} {_name(thin, near)}"
    elif hole <= 180:
        where = f"between {_name(thin, before)} and {_name(thin, after)}"
    else:
        opposite = int(np.abs(turns - 180).argmin())
        where = f"opposite {_name(thin, opposite)}"
        where += f", in the {hole:.0f}° from {_name(thin, before)} round to {_name(thin, after)}"
    if not ring.inward:
        tilt = f", {abs(height):.0f}° {'up' if height > 0 else 'down'}"
        return where + (tilt if abs(height) > _SAME_HEIGHT_DEG else "")
    return where + (f", looking down {height:.0f}°" if height > _DOWN_DEG else ", held level")


def _gap(thin: Thin, ring: Around, number: int, gap: Gap) -> str:
    side, nearest = side_of(thin, ring, gap.direction), _name(thin, gap.nearest)
    missing = "sees the middle of the scene from there" if ring.inward else "looks there"
    advice = "Stand there, if one can." if ring.inward else "Turn there."
    return (
        f"Gap {number}, {side}: no photograph {missing}; the nearest, {nearest}, is "
        f"{gap.angle_deg:.0f}° away. {advice}"
    )


def _place(thin: Thin, letter: str, place: Place) -> str:
    """A thin place: where it is in the photograph that shows it best, and where to step from it."""
    camera, name = thin.cameras[place.best], _name(thin, place.best)
    pixels, _ = camera.project(place.centre[None])
    column, row = np.clip(3 * pixels[0] / (camera.width, camera.height), 0, 2).astype(int)
    seen = f"seen by {counted(place.photographs, 'photograph')}"
    if place.photographs > 1:
        seen += f", over {place.angle_deg:.0f}°"
    told = (
        f"Place {letter}, {_SIDE_WORDS[row][column]} in {name}: {seen}; {place.share:.0%} of all."
    )
    if not place.step:
        return told
    side = f"to the {place.step} of" if place.step != "higher" else "higher than"
    return f"{told} Stand {side} where {name} was taken, by a third of its distance, and show it."


def _floaters(thin: Thin) -> str:
    if not len(thin.floaters):
        return "No splat hangs in the empty space before a camera."
    eyes = np.array([camera.centre for camera in thin.cameras])
    apart = np.linalg.norm(thin.floaters[:, None] - eyes, axis=2).argmin(axis=1)
    first, count = np.unique(apart, return_counts=True)
    order = np.argsort(-count, kind="stable")[:3]
    named = ", ".join(f"{_name(thin, int(first[i]))} ({count[i]})" for i in order)
    many = counted(len(thin.floaters), "splat hangs", "splats hang")
    return f"{many} in the empty space before cameras, most before {named}."


def _name(thin: Thin, number: int) -> str:
    return PurePosixPath(thin.names[number]).stem
