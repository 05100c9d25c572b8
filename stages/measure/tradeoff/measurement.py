"""The curves of one run, from its log and from what is cheap to do again."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from stages import formats
from stages.formats.quantisation import splats_to_write
from stages.formats.values import drop_undrawable
from stages.measure.contribution import Contributions, floaters, measure_contributions
from stages.measure.evaluation import EvaluationView, Score, evaluate, image_renderer
from stages.measure.speed import seconds_per_frame
from stages.measure.tradeoff.curves import Moment, Point, Trade, change_db, mean_db
from stages.measure.tradeoff.thin import Thin, measure_thin
from stages.scene import DrawSettings, QuantisedSplats, Splats, View, evenly_spaced, split_held_out

# Shares of the splats that are left, each taken from the one before: what single splats are worth
# no longer adds up where many go at once.
SHARES = (0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
# Of photographs of training, spread over them, that say which splats go: what none of them shows
# goes first, so as many as the time allows. 24 at least.
DECIDING_PIXELS, _LEAST_DECIDING = 24e6, 24
TIMED_FRAMES = 4

Tell = Callable[[str], None]


@dataclass(frozen=True)
class TradeoffInputs:
    """What is measured. splats: the run's last, in the frame of its cameras. training, held_out:
    photographs that decide, and that judge. levelled: whether up is -Y. history: as training logged
    it. exported: formats. quantised: what was decided on for files; None where nothing was. fitted:
    by format, what its file holds where export fine-tuned it."""

    splats: Splats
    training: Sequence[EvaluationView]
    held_out: Sequence[EvaluationView]
    views: tuple[View, ...]
    units: str
    backend: str
    levelled: bool = True
    history: Sequence[dict[str, Any]] = ()
    exported: tuple[str, ...] = ()
    quantised: QuantisedSplats | None = None
    fitted: Mapping[str, Splats] = field(default_factory=dict)


def measure_tradeoff(material: TradeoffInputs, tell: Tell) -> Trade:
    """All of it; photographs that judge decide nothing. Raises SplatError, as writers do."""
    splats = drop_undrawable(material.splats)[0]
    material = replace(material, splats=splats)
    tell("judging the run's splats")
    own_scores = _scores(material, splats)
    own = _point(material, "as it is", splats, own_scores, own_scores)
    tell("finding what each splat is worth")
    worth = measure_contributions(splats, material.training, material.backend)
    return Trade(
        own=own,
        moments=_moments(material.history),
        formats=_formats(material, own_scores, tell),
        counts=(own, *_fewer(material, own_scores, worth, tell)),
        scores=tuple(own_scores),
        side_px=max(max(p.pixels.shape[:2]) for p in material.held_out),
        thin=_thin(material, worth, tell),
        exported=material.exported,
    )


def _scores(material: TradeoffInputs, splats: Splats) -> list[Score]:
    return evaluate(image_renderer(splats, material.backend), material.held_out)


def _point(
    material: TradeoffInputs, label: str, splats: Splats, found: list[Score], own: list[Score]
) -> Point:
    cameras = [photograph.camera for photograph in material.held_out[:TIMED_FRAMES]]
    seconds = float(np.median(seconds_per_frame(splats, cameras, material.backend)))
    change = change_db(found, own)
    return Point(label, len(splats), mean_db(found), change, frame_s=seconds)


def _moments(history: Sequence[dict[str, Any]]) -> tuple[Moment, ...]:
    return tuple(
        Moment(h["step"], h["splats"], h["seconds"], h["cpu_seconds"], h["psnr_db"])
        for h in history
        if "psnr_db" in h
    )


def _formats(material: TradeoffInputs, own: list[Score], tell: Tell) -> tuple[Point, ...]:
    """The splats written as export does, read back and judged, in every format, smallest first."""
    splats, points = material.splats, []
    with tempfile.TemporaryDirectory() as folder:
        for name, row in formats.FORMATS.items():
            tell(f"writing and judging .{name}")
            path = Path(folder) / f"scene.{name}"
            held = splats_to_write(row, material.quantised) if material.quantised else splats
            held = material.fitted.get(name, held)
            formats.write(path, held, units=material.units, views=material.views)
            size = row.size_bytes(path)
            read = replace(formats.read(path), draw_settings=splats.draw_settings)
            for file in row.files(path):
                file.unlink()
            found = own if _same(read, splats) else _scores(material, read)
            change = change_db(found, own)
            points.append(Point(f".{name}", len(read), mean_db(found), change, size))
    return tuple(sorted(points, key=lambda point: point.size_bytes or 0))


def _same(a: Splats, b: Splats) -> bool:
    """To the bit: then so are the pictures."""
    return all(
        x.shape == y.shape and x.tobytes() == y.tobytes()
        for x, y in zip(a.arrays, b.arrays, strict=True)
    )


def _thin(material: TradeoffInputs, worth: Contributions, tell: Tell) -> Thin:
    tell("looking where the capture is thin")
    cameras = [photograph.camera for photograph in material.training]
    return measure_thin(
        material.splats,
        split_held_out(material.views)[0],
        material.levelled,
        material.held_out,
        floaters(material.splats, worth, cameras),
        material.backend,
    )


def _fewer(
    material: TradeoffInputs, own: list[Score], worth: Contributions, tell: Tell
) -> list[Point]:
    """Fewer and fewer splats: first goes what changes the training pictures least. worth: of
    all."""
    splats, points = material.splats, []
    for share in SHARES:
        count = round(share * len(material.splats))
        if not 0 < count < len(splats):
            continue
        tell(f"leaving {share:.0%} of the splats")
        if len(splats) < len(material.splats):
            worth = measure_contributions(splats, material.training, material.backend)
        splats = splats.take(np.sort(np.argsort(-worth.picture_change, kind="stable")[:count]))
        points.append(_point(material, f"{share:.0%}", splats, _scores(material, splats), own))
    return points


def deciding_views(views: Sequence[View], draw_settings: DrawSettings) -> list[View]:
    """Those photographs of training that decide, at the size that they are judged at."""
    if not views:
        return []
    camera = draw_settings.camera(views[0].camera)
    most = round(DECIDING_PIXELS / (camera.width * camera.height))
    return evenly_spaced(views, max(_LEAST_DECIDING, most))
