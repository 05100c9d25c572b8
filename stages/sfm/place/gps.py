"""Scale, north and place of a reconstruction from the photographs' GPS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stages.base.stage import Report
from stages.scene import Camera, Photo
from stages.scene.place import EAST_DOWN_NORTH, GEOGRAPHIC, EarthPlace, local_positions
from stages.scene.rotations import similarity

_FEWEST = 5
_AGREEING_SHARE = 0.6  # of the photographs with GPS
_WORST_RESIDUAL = 0.15  # of the spread of the cameras; beyond, GPS is too inaccurate
_PHONE_ERROR_M = 10.0  # of a phone's receiver; positions that spread less say nothing of the scale
_HYPOTHESES = 2000  # of the robust fit, at most
_EXACT_M = 1e-3  # of positions, as tags state them
_ACCURATE_M = 0.2  # as positions corrected by a base station (RTK) are
_FLATTEST = 0.05  # second over first extent of the positions that may tilt the world
_MOST_TILT_DEG = 30.0  # by which positions may correct the level of the cameras
_FEWEST_TILTED = 8  # positions without stated errors that may
_DECISIVE = 0.25  # of the spread of heights that they must explain: all but this share


@dataclass(frozen=True)
class MetricScale:
    """How the world becomes metric.

    Args:
        metres: per unit of the old world.
        source: a description for the manifest.
        turn: [3, 3] rotation from the old to the new world, after which +Z is north and +X east,
            if north is known.
        place: of the new world; None if it is not known.
    """

    metres: float
    source: str
    turn: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    place: EarthPlace | None = None

    def poses(self, world_to_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """[V, 4, 4] the poses in the new world."""
        moved = np.array(world_to_camera)
        moved[:, :3, :3] = moved[:, :3, :3] @ self.turn.T
        moved[:, :3, 3] *= self.metres
        return moved

    def cameras(self, cameras: Sequence[Camera]) -> list[Camera]:
        """The cameras in the new world."""
        poses = self.poses(np.array([camera.world_to_camera for camera in cameras]))
        return [replace(c, world_to_camera=pose) for c, pose in zip(cameras, poses, strict=True)]

    def points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """[P, 3] the points in the new world."""
        return np.asarray(self.metres * points @ self.turn.T)

    def followed_by(self, metres: float, turn: NDArray[np.float64]) -> MetricScale:
        """Scaled and rotated once more; the place moves with the world."""
        old_from_new = np.eye(4)
        old_from_new[:3, :3] = turn.T / metres
        place = self.place and self.place.moved(old_from_new)
        return replace(self, metres=self.metres * metres, turn=turn @ self.turn, place=place)


def about_vertical(heading: float) -> NDArray[np.float64]:
    """[3, 3] rotation by `heading` (radians) about y, which points down."""
    c, s = math.cos(heading), math.sin(heading)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def scale_from_gps(
    photos: Sequence[Photo], centres: NDArray[np.float64], levelled: bool, report: Report
) -> MetricScale | None:
    """The scale that takes the cameras to their GPS positions; None if these cannot be used.

    Horizontal positions decide, because heights of phones are less accurate than levelling by
    cameras. All three coordinates decide where positions are accurate, and where a tilt explains
    nearly all differences of height: cameras that look straight down say little about the level.

    Args:
        photos: [V] the registered photographs; faces of one picture count once.
        centres: [V, 3] of their cameras.
        levelled: whether up is -Y.
        report: receives metrics, and a warning where GPS cannot be used.
    """
    pictures = {photo.source: i for i, photo in enumerate(photos)}
    rows = np.array([i for i in pictures.values() if photos[i].gps is not None], np.intp)
    report.metric("with_gps", len(rows))
    if not len(rows):
        return None
    around, there, heights_known = _positions([photos[i] for i in rows])
    here = centres[rows]
    flat_there = there[:, 0] + 1j * there[:, 1]
    spread = float(np.sqrt(np.mean(np.abs(flat_there - flat_there.mean()) ** 2)))
    report.metric("gps_spread_m", round(spread, 3))
    flat = _flat_fit(here, there, levelled)
    if flat.metres:
        _report_fit(flat, report)
    errors = [photos[i].gps_error_m for i in rows]
    exact = heights_known & [e is not None and e <= _ACCURATE_M for e in errors]
    unused = _why_unused(flat, levelled, spread)
    if unused:
        free = _free_fit(here, there, exact)
        few = exact.sum() < _AGREEING_SHARE * len(rows)
        if free is None or few or free.residual_m > _WORST_RESIDUAL * spread:
            _report_unused(unused, len(rows), len(pictures), spread, report)
            return None
        fit = free
        _report_fit(fit, report)
    else:
        fit = _tilted(flat, here, there, heights_known, exact)
    if fit.spatial:
        report.metric("gps_in_three_dimensions", fit.spatial)
    source = f"GPS of {fit.agreeing} photographs, {fit.residual_m:.2g} m off"
    scale = MetricScale(fit.metres, source, fit.turn)
    place = _place(around, scale.points(here), there, fit.inliers, heights_known)
    return replace(scale, place=place)


@dataclass(frozen=True)
class _Fit:
    """A similarity from the old world to the new one, by GPS positions.

    Args:
        metres: per unit of the old world; 0: there is none.
        turn: [3, 3] from the old to the new world.
        inliers: [N] positions that were fitted.
        residual_m: RMS distance of these from the cameras.
        agreeing: how many positions agree with the cameras: these, and others that are no further
            off than positions may be.
        spatial: how many positions were fitted in three dimensions; 0: in the plane only.
    """

    metres: float
    turn: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    residual_m: float
    agreeing: int
    spatial: int = 0


def _flat_fit(here: NDArray[np.float64], there: NDArray[np.float64], levelled: bool) -> _Fit:
    """By horizontal positions. here, there [N, 3]: in the old world; metres east, north and up."""
    factor, inliers, residual, agreeing = 0j, np.zeros(len(here), np.bool_), math.inf, 0
    if levelled and len(here) >= _FEWEST:
        flat_here, flat_there = here[:, 0] + 1j * here[:, 2], there[:, 0] + 1j * there[:, 1]
        factor, inliers, residual = fit_similarity_2d(flat_here, flat_there)
        if factor:
            moved = factor * (flat_here - flat_here[inliers].mean())
            off = np.abs(flat_there - flat_there[inliers].mean() - moved)
            spread = float(np.sqrt(np.mean(np.abs(moved) ** 2)))
            agreeing = int((inliers | (off <= _WORST_RESIDUAL * spread)).sum())
    # (x + iz) e^(i angle) rotates x towards z; `about_vertical` rotates the other way.
    turn = about_vertical(-float(np.angle(factor)))
    return _Fit(float(abs(factor)), turn, inliers, residual, agreeing)


def _free_fit(
    here: NDArray[np.float64], there: NDArray[np.float64], exact: NDArray[np.bool_]
) -> _Fit | None:
    """By the `exact` [N] positions in three dimensions, whatever the level of the cameras."""
    found = _fit_3d(here[exact], there[exact], None, any_tilt=True)
    if found is None:
        return None
    off, count = _off(here[exact], there[exact], *found), int(exact.sum())
    return _Fit(*found, exact, off, count, spatial=count)


def _tilted(
    flat: _Fit,
    here: NDArray[np.float64],
    there: NDArray[np.float64],
    heights_known: NDArray[np.bool_],
    exact: NDArray[np.bool_],
) -> _Fit:
    """The flat fit, in three dimensions where positions allow it (`scale_from_gps`)."""
    exact = exact & flat.inliers
    accurate = int(exact.sum()) >= _FEWEST
    chosen = exact if accurate else flat.inliers & heights_known
    level = None if accurate else flat.metres * flat.turn
    found = _fit_3d(here[chosen], there[chosen], level)
    if found is None:
        return flat
    metres, turn = found
    return replace(flat, metres=metres, turn=turn, spatial=int(chosen.sum()))


def _report_fit(fit: _Fit, report: Report) -> None:
    report.metric("gps_residual_m", round(fit.residual_m, 3))
    report.metric("gps_agreeing", fit.agreeing)


def _positions(
    photos: Sequence[Photo],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """(latitude, longitude and height [3] of a place in the middle, metres east, north and up of it
    [N, 3], whose heights are known [N]). Heights that are not known are those of the middle."""
    places = np.array([[*(photo.gps or (0.0, 0.0)), photo.gps_height or 0.0] for photo in photos])
    known = np.array([photo.gps_height is not None for photo in photos])
    unwrapped = places.copy()
    unwrapped[:, 1] = np.unwrap(places[:, 1], period=360.0)  # across the 180th meridian
    middle = np.median(unwrapped, axis=0)
    middle[2] = np.median(places[known, 2]) if known.any() else 0.0
    places[~known, 2] = middle[2]
    return middle, local_positions(places, middle), known


def _fit_3d(
    here: NDArray[np.float64],
    there: NDArray[np.float64],
    level: NDArray[np.float64] | None,
    *,
    any_tilt: bool = False,
) -> tuple[float, NDArray[np.float64]] | None:
    """(metres per unit, rotation [3, 3] to the new world) by positions [N, 3]; None if they are few
    or nearly on a line, or contradict the level of the cameras.

    Args:
        here, there: in the old world; metres east, north and up.
        level: [3, 3] scale and rotation to the new world by the level of the cameras, for positions
            whose errors are not known: these must then explain the heights much better.
        any_tilt: they may contradict it.
    """
    if len(here) < (_FEWEST if level is None else _FEWEST_TILTED):
        return None
    extents = np.linalg.svd(there - there.mean(axis=0), compute_uv=False)
    if extents[1] < _FLATTEST * extents[0]:
        return None
    metres, rotation, _ = similarity(here, there)
    turn = EAST_DOWN_NORTH.T @ rotation
    if not metres > 0:
        return None
    after = float(np.std(there[:, 2] - metres * here @ rotation[2]))
    if level is not None and after > _DECISIVE * float(np.std(there[:, 2] + here @ level[1])):
        return None
    level_enough = any_tilt or turn[1, 1] >= math.cos(math.radians(_MOST_TILT_DEG))
    return (metres, turn) if level_enough else None


def _off(
    here: NDArray[np.float64],
    there: NDArray[np.float64],
    metres: float,
    turn: NDArray[np.float64],
) -> float:
    """RMS distance in metres of positions [N, 3] in the new world from those of the GPS, apart from
    one offset of all."""
    away = there - metres * here @ turn.T @ EAST_DOWN_NORTH.T
    return float(np.sqrt(np.mean(np.sum((away - away.mean(axis=0)) ** 2, axis=1))))


def _place(
    around: NDArray[np.float64],
    here: NDArray[np.float64],
    there: NDArray[np.float64],
    inliers: NDArray[np.bool_],
    heights_known: NDArray[np.bool_],
) -> EarthPlace:
    """The place of the new world.

    Args:
        around: [3] latitude, longitude and height.
        here: [N, 3] the cameras in the new world.
        there: [N, 3] their GPS positions, east, north and up of `around`.
        inliers, heights_known: [N].
    """
    shift = (there - here @ EAST_DOWN_NORTH.T)[inliers].mean(axis=0)
    with_heights = inliers & heights_known
    ups = there[:, 2] + here[:, 1]
    shift[2] = np.median(ups[with_heights if with_heights.any() else inliers])
    return EarthPlace(GEOGRAPHIC, around, EAST_DOWN_NORTH).beside(EAST_DOWN_NORTH.T @ shift)


def _why_unused(fit: _Fit, levelled: bool, spread: float) -> str:
    """Why the flat fit cannot be used; "" if it can. spread: of the GPS positions, metres."""
    count = len(fit.inliers)
    if count < _FEWEST:
        return f"{_FEWEST} photographs are needed"
    if not levelled:
        return "the up direction was not found"
    if fit.metres == 0:
        return "most cameras or positions are at one place"
    if fit.agreeing < max(_FEWEST, _AGREEING_SHARE * count):
        return f"only {fit.agreeing} of them agree with the cameras"
    if fit.residual_m > _WORST_RESIDUAL * spread:
        return f"they differ from the cameras by {fit.residual_m:.1f} m (RMS)"
    return ""


def _report_unused(why: str, count: int, total: int, spread: float, report: Report) -> None:
    """Report why GPS is not used; as a warning if the scale could have come from it.

    Args:
        why: the reason.
        count, total: photographs with GPS, and all photographs.
        spread: of the GPS positions, metres.
        report: receives a metric and the warning.
    """
    report.metric("gps_unused", why)
    if spread >= _PHONE_ERROR_M:
        report.warn(
            "sfm-gps-unused",
            f"{count} of {total} photographs have GPS, spread over {spread:.0f} m (RMS). It is not "
            f"used for scale and north: {why}. Give a known distance with --scale if the scene "
            "must be in metres.",
        )


def fit_similarity_2d(
    here: NDArray[np.complex128], there: NDArray[np.complex128]
) -> tuple[complex, NDArray[np.bool_], float]:
    """Robust fit of a similarity of the plane that maps `here` [N] to `there` [N].

    Least median of squares over hypotheses from two points each (Rousseeuw 1984), then least
    squares over inliers, in metres. Returns (complex factor, inliers [N], RMS residual of the
    inliers).
    """
    first, second = np.triu_indices(len(here), 1)
    chosen = np.linspace(0, len(first) - 1, min(len(first), _HYPOTHESES)).astype(int)
    best, least = 0j, math.inf
    for i, j in zip(first[chosen], second[chosen], strict=True):
        if abs(here[j] - here[i]) == 0:
            continue
        factor = (there[j] - there[i]) / (here[j] - here[i])
        off = float(np.median(np.abs(there - there[i] - factor * (here - here[i]))))
        if off < least:
            best, least, anchor = factor, off, i
    if not math.isfinite(least):
        return 0j, np.zeros(len(here), np.bool_), math.inf
    # Two of the distances are 0, so with few points the median is too small (Rousseeuw and Leroy
    # 1987, chapter 5).
    reach = 3.0 * (1.0 + 5.0 / max(len(here) - 2, 1)) * least + _EXACT_M
    inliers = np.abs(there - there[anchor] - best * (here - here[anchor])) <= reach
    a, b = here[inliers] - here[inliers].mean(), there[inliers] - there[inliers].mean()
    factor = complex((a.conj() @ b) / max(float((a.conj() @ a).real), 1e-300))
    return factor, inliers, float(np.sqrt(np.mean(np.abs(b - factor * a) ** 2)))
