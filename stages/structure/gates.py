"""What a reconstruction must fulfil, and what to tell the photographer if it does not.

A bad reconstruction looks plausible: most of its photographs may be registered with a small
reprojection error although the scene is wrong. So several figures are looked at, each of which
catches what the others let through. Pure functions on plain numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median

from stages.base.text import counted

CALIBRATED, PLANAR, PANORAMIC, PLANAR_OR_PANORAMIC = 2, 4, 5, 6  # COLMAP's TwoViewGeometry


@dataclass(frozen=True)
class ModelStatistics:
    """What is known of one reconstruction.

    photographs: given; registered: in the largest model; models: sizes of all models found.
    mean_reprojection_error_px: over points, of each point's mean, as COLMAP counts it;
    long_side_px: of the photographs.
    median_triangulation_angle_deg: over points, of the widest angle between two of its rays.
    baseline_over_depth: spread of the cameras over distance to the points.
    weak_photographs: registered with fewer than 30 points in view.
    distortion: k of SIMPLE_RADIAL, of the camera where it is largest. focal_over_prior: of the
    camera that is farthest from EXIF, None without EXIF.
    pairs_checked: of photographs with many matches that agree with each other;
    pairs_contradicting: those of them whose matches do not fit the model; contradicting: one such
    pair's names. turn_of_other_deg: the largest angle between this model's directions of
    photographs and those in another model of some of them.
    link_points, link_views: where the model hangs together most loosely: points seen from both
    parts, and photographs of the smaller part (0: too small to have parts).
    """

    photographs: int
    registered: int = 0
    models: tuple[int, ...] = ()
    mapper: str = "incremental"
    timed_out: bool = False
    points: int = 0
    mean_reprojection_error_px: float = 0.0
    long_side_px: int = 1600
    mean_track_length: float = 0.0
    median_triangulation_angle_deg: float = 0.0
    baseline_over_depth: float = 0.0
    weak_photographs: int = 0
    distortion: float = 0.0
    focal_over_prior: float | None = None
    pairs_checked: int = 0
    pairs_contradicting: int = 0
    contradicting: tuple[str, ...] = ()
    turn_of_other_deg: float = 0.0
    link_points: int = 0
    link_views: int = 0


@dataclass(frozen=True)
class Thresholds:
    """Where the gates stand. Each figure is explained at `Figures`.

    Measured on bad captures: turning on the spot gives triangulation angles of 2.2 degrees; a date
    stamp k = -8.6 and 3.9 times the focal length; a blank wall 15 points a photograph at 0.13 px;
    strong blur 76 keypoints a photograph (mild blur, which works, 257). Good ones: 450 and 250
    points a photograph at 0.34 and 1.02 px of 1600.
    Of pairs with many matches, good models contradict none (of 150, 35 and 777), that of an object
    turned over half-way 15 of 67; where good ones hang together most loosely, 1,032, 222 and 1,406
    points are seen from both sides.
    """

    registered_share: float = 0.8
    fewest_views: int = 3
    keypoints: int = 200
    points_per_view: int = 20
    error_share_of_long_side: float = 0.00125  # 2 px of 1600
    error_floor_px: float = 1.5
    track_length: float = 2.3
    triangulation_angle_deg: float = 3.0
    baseline_over_depth: float = 0.05
    weak_share: float = 0.25
    distortion: float = 1.0
    focal_ratio: float = 2.0
    contradicting_share: float = 0.1
    fewest_contradicting: int = 3
    turn_of_other_deg: float = 15.0
    link_points: int = 30
    link_points_global: int = 100
    same_place_share: float = 0.9


@dataclass(frozen=True)
class Failure:
    """A gate that did not open; the fields are those of `SplatError`."""

    code: str
    given: str
    wanted: str
    hint: str


MORE_OVERLAP = (
    "Take photographs in small steps around the scene so that each shares 60-80 % of its picture "
    "with the next, or add some between those that were left out and the rest."
)
MOVE = (
    "Walk around the scene instead of turning on the spot: every photograph should be taken from "
    "another place, a step apart."
)

_UNIQUE = "Everything must stay where it is, and look the same nowhere else."
_APART = (
    "If the subject was turned or moved between photographs, put those before and those after into "
    "folders of their own, or hide everything else by masks; if the same picture or pattern is "
    "there twice, hide one of the two. If the arrangement is right all the same, --allow-partial "
    "goes on with it."
)


def check_keypoints(counts: list[int], limits: Thresholds | None = None) -> list[Failure]:
    """Before matching: enough features in the typical photograph?"""
    limits = limits or Thresholds()
    typical = median(counts) if counts else 0
    if typical >= limits.keypoints:
        return []
    return [
        Failure(
            "sfm-too-few-features",
            f"The typical photograph shows only {typical:.0f} recognisable spots.",
            f"At least {limits.keypoints} are needed to find out where it was taken.",
            "Check that the photographs are sharp and well lit, and that the subject is no blank "
            "or shiny surface; patterned paper or cloth in the scene helps.",
        )
    ]


def check_pairs(
    pairs: list[tuple[int, int, int, int]], photographs: int, limits: Thresholds | None = None
) -> list[Failure]:
    """After matching: do the photographs hang together, and were they taken from several places?

    pairs: (first, second, inliers, configuration) as `database.verified_pairs` gives them.
    """
    limits = limits or Thresholds()
    if not pairs:
        return [
            Failure(
                "sfm-no-matches",
                "No two photographs show the same thing.",
                "Neighbouring photographs must overlap.",
                MORE_OVERLAP,
            )
        ]
    failures = []
    # A turn on the spot maps one picture to the next by a homography. COLMAP calls that panoramic
    # where it also finds no translation; a flat scene alone (drones, walls) is called planar.
    turning = sum(config in (PANORAMIC, PLANAR_OR_PANORAMIC) for _, _, _, config in pairs)
    if turning >= limits.same_place_share * len(pairs):
        failures.append(_no_parallax("Nearly all pairs of photographs"))
    groups = connected_groups(pairs, photographs)
    if len(groups[0]) < limits.registered_share * photographs:
        others = [len(group) for group in groups[1:] if len(group) > 1]
        single = sum(len(group) == 1 for group in groups)
        failures.append(_separate(len(groups[0]), others, single, photographs))
    return failures


def connected_groups(pairs: list[tuple[int, int, int, int]], photographs: int) -> list[list[int]]:
    """Photographs that are linked by matches, directly or through others; largest group first."""
    parent = list(range(photographs))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for first, second, _, _ in pairs:
        parent[max(root(first), root(second))] = min(root(first), root(second))
    groups: dict[int, list[int]] = {}
    for i in range(photographs):
        groups.setdefault(root(i), []).append(i)
    return sorted(groups.values(), key=lambda group: (-len(group), group))


def check_model(figures: ModelStatistics, limits: Thresholds | None = None) -> list[Failure]:
    """After mapping: every gate that the largest model fails, the gravest first."""
    limits = limits or Thresholds()
    if figures.timed_out:
        return [_timed_out(figures)]
    if figures.models and not figures.points:
        # Photographs were placed, but every ray to a point ran parallel and was thrown away.
        return [_no_parallax("No depth could be measured: photographs")]
    if figures.registered < limits.fewest_views or not figures.points:
        return [_no_model(figures)]
    checks = (_check_geometry, _check_camera, _check_registered, _check_support, _check_unity)
    return [failure for check in checks for failure in check(figures, limits)]


def borderline_failures(figures: ModelStatistics) -> list[Failure]:
    """What is too little to refuse a model, and too much to be silent about it."""
    return _check_unity(figures, Thresholds(contradicting_share=0.02, link_points=100))


def _check_geometry(figures: ModelStatistics, limits: Thresholds) -> list[Failure]:
    angle, baseline = figures.median_triangulation_angle_deg, figures.baseline_over_depth
    if angle < limits.triangulation_angle_deg:
        return [_no_parallax(f"Points are seen under an angle of {angle:.1f} degrees: photographs")]
    if baseline < limits.baseline_over_depth:
        return [_no_parallax(f"The cameras moved by {baseline:.3f} of their distance: photographs")]
    return []


def _check_camera(figures: ModelStatistics, limits: Thresholds) -> list[Failure]:
    failures = []
    hint = (
        "Look for something that stays in the same place of every picture (a date stamp, a frame, "
        "a dirty lens) and crop it away; and do not mix zoom settings."
    )
    if abs(figures.distortion) > limits.distortion:
        failures.append(
            Failure(
                "sfm-implausible-distortion",
                f"The lens came out with a distortion of k = {figures.distortion:.2f}.",
                f"Lenses have |k| below {limits.distortion:g}.",
                hint,
            )
        )
    ratio = figures.focal_over_prior
    if ratio is not None and not 1 / limits.focal_ratio <= ratio <= limits.focal_ratio:
        failures.append(
            Failure(
                "sfm-implausible-focal",
                f"The focal length came out as {ratio:.2f} times what the photographs' EXIF says.",
                f"It should lie within a factor of {limits.focal_ratio:g}.",
                hint,
            )
        )
    return failures


def _check_registered(figures: ModelStatistics, limits: Thresholds) -> list[Failure]:
    share = figures.registered / max(1, figures.photographs)
    if share >= limits.registered_share:
        return []
    others = f" ({len(figures.models)} separate models)" if len(figures.models) > 1 else ""
    return [
        Failure(
            "sfm-too-few-registered",
            f"Only {figures.registered} of {figures.photographs} photographs could be placed "
            f"together{others}.",
            f"At least {limits.registered_share:.0%} are wanted.",
            MORE_OVERLAP + " If the folder holds several scenes, put each into a folder of its "
            "own. --allow-partial goes on with what there is.",
        )
    ]


def _check_support(figures: ModelStatistics, limits: Thresholds) -> list[Failure]:
    """Enough points, seen often enough, accurately enough?"""
    failures = []
    texture = "Add texture to blank surfaces (patterned paper, cloth), and take more photographs."
    if figures.points < limits.points_per_view * figures.registered:
        failures.append(
            Failure(
                "sfm-too-few-points",
                f"Only {counted(figures.points, 'point')} could be found in "
                f"{counted(figures.registered, 'photograph')}.",
                f"At least {limits.points_per_view} a photograph are wanted.",
                texture,
            )
        )
    if figures.weak_photographs > limits.weak_share * figures.registered:
        failures.append(
            Failure(
                "sfm-weak-photographs",
                f"{figures.weak_photographs} of {figures.registered} photographs see fewer than "
                "30 of the points found.",
                f"At most {limits.weak_share:.0%} may.",
                MORE_OVERLAP,
            )
        )
    if figures.mean_track_length < limits.track_length:
        failures.append(
            Failure(
                "sfm-short-tracks",
                f"A point is seen by {figures.mean_track_length:.2f} photographs on average.",
                f"At least {limits.track_length} are wanted.",
                MORE_OVERLAP,
            )
        )
    largest = max(limits.error_floor_px, limits.error_share_of_long_side * figures.long_side_px)
    if not figures.mean_reprojection_error_px <= largest:
        failures.append(
            Failure(
                "sfm-high-error",
                f"Points miss their place by {figures.mean_reprojection_error_px:.2f} px on "
                "average.",
                f"At most {largest:.2f} px are wanted.",
                "The scene must stand still while it is photographed, and the photographs must be "
                "sharp; leave out moving things and stabilised video.",
            )
        )
    return failures


def _check_unity(figures: ModelStatistics, limits: Thresholds) -> list[Failure]:
    """Do pairs of photographs, and the parts of the model, belong together?"""
    failures = []
    odd, checked = figures.pairs_contradicting, figures.pairs_checked
    if odd >= limits.fewest_contradicting and odd > limits.contradicting_share * checked:
        failures.append(
            Failure(
                "sfm-contradictions",
                f"{odd} of {checked} pairs of photographs that match well ({_pair_of(figures)}, "
                "for example) contradict the arrangement found.",
                _UNIQUE,
                _APART,
            )
        )
    if figures.turn_of_other_deg > limits.turn_of_other_deg:
        failures.append(
            Failure(
                "sfm-contradictions",
                "Some photographs fit two arrangements, which turn them by "
                f"{figures.turn_of_other_deg:.0f} degrees against each other.",
                _UNIQUE,
                _APART,
            )
        )
    # The global mapper places everything; without a common point that is a guess.
    least = limits.link_points_global if figures.mapper == "global" else limits.link_points
    if figures.link_views and figures.link_points < least:
        failures.append(
            Failure(
                "sfm-weak-link",
                f"{figures.link_views} of {figures.registered} photographs hang together with the "
                f"others by {counted(figures.link_points, 'point')} only, so that nobody knows "
                "where they belong.",
                f"At least {least} points must be seen from both sides.",
                MORE_OVERLAP,
            )
        )
    return failures


def _pair_of(figures: ModelStatistics) -> str:
    return " and ".join(figures.contradicting)


def _no_parallax(what: str) -> Failure:
    return Failure(
        "sfm-no-parallax",
        f"{what} were taken from nearly the same place.",
        "Depth shows only when the camera moves sideways.",
        MOVE,
    )


def _separate(largest: int, others: list[int], single: int, photographs: int) -> Failure:
    parts = [str(largest), *map(str, others[:5])]
    match = "matches" if single == 1 else "match"
    alone = f", and {counted(single, 'photograph')} {match} no other" if single else ""
    return Failure(
        "sfm-separate-groups",
        f"The {photographs} photographs fall into unconnected groups of {', '.join(parts)}{alone}.",
        "All must show the same scene with overlap.",
        "Put each scene into a folder of its own, or add photographs that connect the groups. "
        "--allow-partial goes on with the largest group.",
    )


def _no_model(figures: ModelStatistics) -> Failure:
    return Failure(
        "sfm-no-model",
        f"No arrangement of the {figures.photographs} photographs could be found"
        + (
            f" ({figures.registered} placed, {counted(figures.points, 'point')})."
            if figures.registered
            else "."
        ),
        "At least 3 photographs must see the same points from different places.",
        f"{MOVE} {MORE_OVERLAP}",
    )


def _timed_out(figures: ModelStatistics) -> Failure:
    return Failure(
        "sfm-timed-out",
        f"The search was cut off with {figures.registered} of {figures.photographs} photographs "
        "placed.",
        "It must come to an end.",
        "Allow more time with --max-minutes, use fewer or smaller photographs, or accept what "
        "there is with --allow-partial.",
    )
