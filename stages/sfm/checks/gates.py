"""Quality gates: what a reconstruction must fulfil, and advice for the photographer if it does not.

A bad reconstruction looks plausible: most photographs may be registered with a small reprojection
error although the scene is wrong. So several statistics are checked. Each catches failures that the
others miss."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stages.base.errors import ReconstructionError, SplatError
from stages.base.text import counted

CALIBRATED, PLANAR, PANORAMIC, PLANAR_OR_PANORAMIC = 2, 4, 5, 6  # COLMAP's TwoViewGeometry


@dataclass(frozen=True)
class ModelStatistics:
    """Statistics of one reconstruction.

    Args:
        photographs: how many were given.
        registered: how many are in the largest model.
        models: registered photographs of each model found.
        learned: whether learned features took part.
        timed_out: whether the mapper ran out of time.
        points: in the largest model.
        mean_reprojection_error_px: mean over points of each point's mean error, as in COLMAP.
        long_side_px: longer side of the photographs.
        mean_track_length: mean number of photographs that observe a point.
        median_triangulation_angle_deg: median over points of the widest angle between two rays.
        baseline_over_depth: spread of the cameras over their distance to the points.
        flatness: thickness of the points across their best plane, over their smaller extent in it.
        sideways_share: RMS of the camera motion across the optical axes, over all camera motion.
        distortion: k of SIMPLE_RADIAL, of the camera with the largest |k|.
        focal_over_prior: estimated focal length over that of EXIF, of the camera where this ratio
            is farthest from 1; None without EXIF.
        pairs_checked: pairs of photographs with at least 30 verified matches.
        pairs_inconsistent: checked pairs that contradict the poses of the model, in one of two
            ways: their verified matches do not fit the poses, or they are turned.
        pairs_turned: pairs whose verified matches fit, while the matches that do not fit agree on
            another rotation of the scene.
        inconsistent_pair: the names of one inconsistent pair.
        rotation_to_other_deg: largest disagreement between this model and another of COLMAP's
            models about the relative rotation of photographs that are in both.
        cut_points: points observed in both parts when the model is cut where fewest points hold it
            together (`statistics.weakest_cut`).
        cut_views: photographs in the smaller part; 0: the model is too small to cut.
    """

    photographs: int
    registered: int = 0
    models: tuple[int, ...] = ()
    learned: bool = False
    timed_out: bool = False
    points: int = 0
    mean_reprojection_error_px: float = 0.0
    long_side_px: int = 1600
    mean_track_length: float = 0.0
    median_triangulation_angle_deg: float = 0.0
    baseline_over_depth: float = 0.0
    flatness: float = 1.0
    sideways_share: float = 1.0
    distortion: float = 0.0
    focal_over_prior: float | None = None
    pairs_checked: int = 0
    pairs_inconsistent: int = 0
    pairs_turned: int = 0
    inconsistent_pair: tuple[str, ...] = ()
    rotation_to_other_deg: float = 0.0
    cut_points: int = 0
    cut_views: int = 0

    @property
    def left_out(self) -> int:
        """Photographs that are not in the largest model."""
        return self.photographs - self.registered


@dataclass(frozen=True)
class Thresholds:
    """The thresholds of the gates. Each statistic is explained at `ModelStatistics`.

    Measured on bad captures: a turn on the spot gives triangulation angles of 2.2 degrees; a date
    stamp k = -8.6 and 3.9 times the focal length; a blank wall 15 points a photograph at 0.13 px;
    strong blur 76 keypoints a photograph (mild blur, which works, 257). Good captures: 450 and 250
    points a photograph at 0.34 and 1.02 px of 1600.
    Good models are consistent with all of their pairs (150, 35 and 777). The model of an object
    that was turned over half-way is inconsistent with 15 of 67. The weakest cuts of good models
    hold 1,032, 222 and 1,406 points.
    A zoom from one place is the same as moving straight towards a poster: a flatness of 0.02 to
    0.04 and sideways motion of 0.03. Good models have 0.13 and 0.30 at least.
    Learned features found 47 and 96 points between parts that do not belong together, and 189 and
    more at the weakest cuts of good models.
    """

    registered_share: float = 0.8
    fewest_views: int = 3
    keypoints: int = 200
    points_per_view: int = 20
    error_share_of_long_side: float = 0.00125  # 2 px of 1600
    error_floor_px: float = 1.5
    triangulation_angle_deg: float = 3.0
    baseline_over_depth: float = 0.05
    flatness: float = 0.1
    sideways_share: float = 0.1
    distortion: float = 1.0
    focal_ratio: float = 2.0
    inconsistent_share: float = 0.15
    fewest_inconsistent: int = 3
    rotation_to_other_deg: float = 15.0
    cut_points: int = 30
    cut_points_learned: int = 150
    same_position_share: float = 0.9


THRESHOLDS = Thresholds()
CONTRADICTED_SHARE = (
    0.02  # of pairs that contradict a model; above, training decides if it is right
)


STAND_STILL = (
    "If the subject was turned or moved between photographs, hide everything else by masks (a "
    "folder of black and white pictures, --masks), or leave out the photographs after that."
)


def failure(code: str, given: str, wanted: str, hint: str) -> SplatError:
    """The error for a gate that was not passed. It is raised if no configuration passes."""
    return ReconstructionError(code, given=given, wanted=wanted, hint=hint)


MORE_OVERLAP = (
    "Take photographs in small steps around the scene so that each shares 60-80 % of its picture "
    "with the next, or add some between those that were left out and the rest."
)
MOVE = (
    "Walk around the scene instead of turning on the spot: every photograph should be taken from "
    "another place, a step apart."
)
MOVE_ASIDE = (
    "Walk around the scene instead of zooming or walking straight on: every photograph should be "
    "taken from another place, a step to the side."
)
IF_RIGHT = " If the poses are right all the same, --allow-partial goes on with them."


def check_keypoints(counts: list[int]) -> list[SplatError]:
    """Before matching: does the median photograph have enough features?"""
    typical = median(counts) if counts else 0
    if typical >= THRESHOLDS.keypoints:
        return []
    return [
        failure(
            "sfm-too-few-features",
            f"The median photograph has only {typical:.0f} features that can be matched.",
            f"At least {THRESHOLDS.keypoints} are needed to find its camera pose.",
            "Check that the photographs are sharp and well lit, and that the subject is no blank "
            "or shiny surface; patterned paper or cloth in the scene helps.",
        )
    ]


def check_pairs(pairs: list[tuple[int, int, int, int]], photographs: int) -> list[SplatError]:
    """After matching: do the pairs connect the photographs, and did the camera move?

    pairs: (first, second, inliers, configuration) as `database.verified_pairs` gives them.
    """
    if not pairs:
        return [
            failure(
                "sfm-no-matches",
                "No two photographs match.",
                "Neighbouring photographs must overlap.",
                MORE_OVERLAP,
            )
        ]
    failures = []
    # A pure rotation maps one picture to the next by a homography. COLMAP calls such a pair
    # panoramic if it also finds no translation; a flat scene alone (drones, walls) is planar.
    rotating = sum(config in (PANORAMIC, PLANAR_OR_PANORAMIC) for _, _, _, config in pairs)
    if rotating >= THRESHOLDS.same_position_share * len(pairs):
        failures.append(no_parallax("Nearly all pairs of photographs"))
    groups = connected_groups(pairs, photographs)
    if len(groups[0]) < THRESHOLDS.registered_share * photographs:
        failures.append(_separate(groups, photographs))
    return failures


def connected_groups(pairs: Sequence[Sequence[int]], photographs: int) -> list[list[int]]:
    """The groups of photographs that pairs connect, as sorted positions; largest first. pairs: each
    begins with two positions."""
    links = np.array([pair[:2] for pair in pairs], np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(links)), tuple(links.T)), shape=(photographs, photographs))
    _, component = connected_components(graph, directed=False)
    groups = [np.flatnonzero(component == c).tolist() for c in range(component.max() + 1)]
    return sorted(groups, key=lambda group: (-len(group), group))


def check_model(model: ModelStatistics) -> list[SplatError]:
    """After mapping: every gate that the largest model fails, the most serious first."""
    if model.timed_out:
        return [_timed_out(model)]
    if model.models and not model.points:
        # Photographs were registered, but all points were dropped because their rays are parallel.
        return [no_parallax("No depth could be measured: photographs")]
    if model.registered < THRESHOLDS.fewest_views or not model.points:
        return [_no_model(model)]
    checks = (_check_geometry, _check_camera, _check_registered, _check_support, _check_consistency)
    return [found for check in checks for found in check(model, THRESHOLDS)]


def borderline_failures(model: ModelStatistics) -> list[SplatError]:
    """Failures of stricter thresholds, which deserve a warning but do not refuse a model."""
    stricter = Thresholds(cut_points=100)
    return list(_check_consistency(model, stricter))


def contradicted(model: ModelStatistics, share: float) -> bool:
    """Whether more than a `share` of the pairs contradict the model, and some do."""
    bad = model.pairs_inconsistent
    return bad >= THRESHOLDS.fewest_inconsistent and bad > share * model.pairs_checked


def poses_contradicted(model: ModelStatistics) -> bool:
    """Whether the verified matches of so many pairs contradict the poses that they may be wrong.
    Turned pairs say nothing about that."""
    misfit = model.pairs_inconsistent - model.pairs_turned
    share = CONTRADICTED_SHARE * model.pairs_checked
    return misfit >= THRESHOLDS.fewest_inconsistent and misfit > share


def _check_geometry(model: ModelStatistics, thresholds: Thresholds) -> Iterator[SplatError]:
    angle, baseline = model.median_triangulation_angle_deg, model.baseline_over_depth
    if angle < thresholds.triangulation_angle_deg:
        yield no_parallax(f"The median triangulation angle is {angle:.1f} degrees: photographs")
    elif baseline < thresholds.baseline_over_depth:
        yield no_parallax(
            f"The cameras moved by {baseline:.3f} of their distance to the scene: photographs"
        )
    elif model.flatness < thresholds.flatness and model.sideways_share < thresholds.sideways_share:
        yield no_parallax(
            "All points lie in one plane and the cameras move straight towards it, which is what a "
            "zoom gives: photographs",
            MOVE_ASIDE,
        )


def _check_camera(model: ModelStatistics, thresholds: Thresholds) -> Iterator[SplatError]:
    if abs(model.distortion) > thresholds.distortion:
        yield failure(
            "sfm-implausible-distortion",
            f"The radial distortion of the lens was estimated as k = {model.distortion:.2f}.",
            f"Lenses have |k| below {thresholds.distortion:g}.",
            "Look for something that stays in the same place of every picture (a date stamp, a "
            "frame, a dirty lens) and crop it away; and do not mix zoom settings.",
        )
    ratio = model.focal_over_prior
    if ratio is not None and not 1 / thresholds.focal_ratio <= ratio <= thresholds.focal_ratio:
        yield failure(
            "sfm-implausible-focal",
            f"The focal length was estimated as {ratio:.2f} times what the photographs' EXIF says.",
            f"It should lie within a factor of {thresholds.focal_ratio:g}.",
            "A walk straight on, or few matches, leave the focal length open: use larger "
            "photographs (--max-side) and more overlap, from places to the side, too. If they were "
            "cropped or zoomed after EXIF was written, remove it.",
        )


def _check_registered(model: ModelStatistics, thresholds: Thresholds) -> Iterator[SplatError]:
    if model.registered < thresholds.registered_share * max(1, model.photographs):
        others = f" ({len(model.models)} separate models)" if len(model.models) > 1 else ""
        yield failure(
            "sfm-too-few-registered",
            f"Only {model.registered} of {model.photographs} photographs could be "
            f"registered in one model{others}.",
            f"At least {thresholds.registered_share:.0%} are needed.",
            MORE_OVERLAP + " If the folder holds several scenes, put each into a folder of its "
            "own. --allow-partial goes on with the largest model.",
        )


def _check_support(model: ModelStatistics, thresholds: Thresholds) -> Iterator[SplatError]:
    """Are there enough points, with small enough errors?"""
    if model.points < thresholds.points_per_view * model.registered:
        yield failure(
            "sfm-too-few-points",
            f"Only {counted(model.points, 'point')} could be triangulated from "
            f"{counted(model.registered, 'photograph')}.",
            f"At least {thresholds.points_per_view} for each photograph are needed.",
            "Add texture to blank surfaces (patterned paper, cloth), and take more photographs.",
        )
    relative = thresholds.error_share_of_long_side * model.long_side_px
    largest = max(thresholds.error_floor_px, relative)
    if not model.mean_reprojection_error_px <= largest:
        yield failure(
            "sfm-high-error",
            f"The mean reprojection error is {model.mean_reprojection_error_px:.2f} px.",
            f"It may be {largest:.2f} px at most.",
            "The scene must stand still while it is photographed, and the photographs must be "
            "sharp; leave out moving things and stabilised video.",
        )


def _check_consistency(model: ModelStatistics, thresholds: Thresholds) -> Iterator[SplatError]:
    """Do the verified pairs fit the model, and are its parts well connected?"""
    bad, checked = model.pairs_inconsistent, model.pairs_checked
    if contradicted(model, thresholds.inconsistent_share):
        yield _contradiction(
            f"The matches of {bad} of {checked} pairs of photographs "
            f"({' and '.join(model.inconsistent_pair)}, for example) contradict the camera poses "
            "found."
        )
    if model.rotation_to_other_deg > thresholds.rotation_to_other_deg:
        yield _contradiction(
            "Some photographs are in two models, whose relative rotations differ by "
            f"{model.rotation_to_other_deg:.0f} degrees."
        )
    least = thresholds.cut_points_learned if model.learned else thresholds.cut_points
    if model.cut_views and model.cut_points < least:
        yield failure(
            "sfm-weak-link",
            f"{model.cut_views} of {model.registered} photographs share only "
            f"{counted(model.cut_points, 'point')} with the others, too few to know where they "
            "belong.",
            f"At least {least} points must be observed in both parts.",
            MORE_OVERLAP,
        )


def _contradiction(given: str) -> SplatError:
    return failure(
        "sfm-contradictions",
        given,
        "Nothing may move between photographs, and no part of the scene may look like another.",
        f"{STAND_STILL} If the same picture or pattern is there twice, hide one of the two."
        + IF_RIGHT,
    )


def no_parallax(what: str, hint: str = MOVE) -> SplatError:
    return failure(
        "sfm-no-parallax",
        f"{what} were taken from nearly the same place.",
        "Depth can be measured only when the camera moves sideways.",
        hint,
    )


def _separate(groups: list[list[int]], photographs: int) -> SplatError:
    single = sum(len(group) == 1 for group in groups)
    parts = [str(len(group)) for group in groups if len(group) > 1 or group is groups[0]]
    match = "matches" if single == 1 else "match"
    alone = f", and {counted(single, 'photograph')} {match} no other" if single else ""
    return failure(
        "sfm-separate-groups",
        f"The {photographs} photographs fall into unconnected groups of "
        f"{', '.join(parts[:6])}{alone}.",
        "All must show the same scene with overlap.",
        "Put each scene into a folder of its own, or add photographs that connect the groups. "
        "--allow-partial goes on with the largest group.",
    )


def _no_model(model: ModelStatistics) -> SplatError:
    found = f" ({model.registered} were, with {counted(model.points, 'point')})"
    return failure(
        "sfm-no-model",
        f"The {model.photographs} photographs could not be registered"
        f"{found if model.registered else ''}.",
        "At least 3 photographs must show the same points from different places.",
        f"{MOVE} {MORE_OVERLAP}",
    )


def _timed_out(model: ModelStatistics) -> SplatError:
    return failure(
        "sfm-timed-out",
        f"Mapping ran out of time with {model.registered} of {model.photographs} "
        "photographs registered.",
        "Mapping must finish.",
        "Allow more time with --max-minutes, use fewer or smaller photographs, or accept the "
        "model found so far with --allow-partial.",
    )
