"""Where a run's capture is thin, and how its splats look from elsewhere, as plain values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.measure.coverage import (
    Around,
    Gap,
    Patches,
    Place,
    around,
    gaps,
    patches_of,
    thin_places,
)
from stages.measure.evaluation import EvaluationView, image_renderer
from stages.measure.shimmer import Framing, framings, shimmer, small_psnr_db
from stages.scene import Camera, Splats, View, evenly_spaced, look_at
from stages.scene.framing import median_depth

MOST_PHOTOGRAPHS = 200  # that coverage is found by
FRAMED = 3  # photographs from which extremes are drawn


@dataclass(frozen=True)
class Thin:
    """names, cameras: of the photographs that training saw, at most 200 of them, as `patches` and
    the others number them. floaters [F, 3]: places. framings: how the splats look from elsewhere.
    small_psnr_db: of held-out photographs a quarter as large a side: drawn so, drawn whole and
    scaled down. ring: None, and no gaps or places, where the photographs show no splat."""

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    patches: Patches
    ring: Around | None
    gaps: tuple[Gap, ...]
    places: tuple[Place, ...]
    floaters: NDArray[np.float64]
    framings: tuple[Framing, ...]
    small_psnr_db: tuple[float, float]


def measure_thin(
    splats: Splats,
    training: Sequence[View],
    levelled: bool,
    held_out: Sequence[EvaluationView],
    hanging: NDArray[np.bool_],
    backend: str,
) -> Thin:
    """hanging [N]: which splats are floaters; the others as in `Material`."""
    chosen = evenly_spaced(training, MOST_PHOTOGRAPHS)
    cameras = tuple(splats.draw_settings.camera(view.camera) for view in chosen)
    patches = patches_of(splats, cameras, backend)
    ring = around(cameras, patches, levelled) if len(patches.centres) else None
    empty = gaps(ring, patches) if ring else ()
    draw = image_renderer(splats, backend)
    seen = [photograph.camera for photograph in evenly_spaced(held_out, FRAMED)]
    framed = framings(draw, [(c, median_depth(c, splats.means)) for c in seen])
    if ring and ring.inward and empty:
        eye = ring.middle + ring.reach * empty[0].direction
        unseen = replace(seen[0], world_to_camera=look_at(eye, ring.middle, up=ring.up))
        framed += (Framing("from gap 1", *shimmer(draw, unseen, ring.reach)),)
    return Thin(
        names=tuple(view.name for view in chosen),
        cameras=cameras,
        patches=patches,
        ring=ring,
        gaps=empty,
        places=thin_places(splats, patches, cameras, backend) if ring else (),
        floaters=splats.means[hanging].astype(np.float64),
        framings=framed,
        small_psnr_db=small_psnr_db(draw, held_out),
    )
