"""Settings of structure from motion. Imports neither NumPy nor torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.base.settings import setting
from stages.base.stage import Stage, in_module


@dataclass(frozen=True)
class SfmSettings:
    """Settings of structure from motion."""

    seed: int = setting(
        0,
        "Seed of every random choice; same seed, same result.",
        panel="Advanced",
        min=0,
        max=2**31 - 1,
    )
    max_features: int = setting(
        12_288, "Approximate number of SIFT features in each photograph.", min=100, max=1_000_000
    )
    features: str = setting(
        "auto",
        "sift; auto (SIFT, and learned features where it leaves photographs out, if they are "
        "installed); or learned (both from the start).",
        panel="Advanced",
        choices=("auto", "sift", "learned"),
    )
    allow_partial: bool = setting(
        False,
        "Use the best reconstruction found even if it fails the quality gates.",
        panel="Advanced",
        midway=True,
    )
    cameras: Path | None = setting(
        None,
        "File or folder of known camera poses, of COLMAP, nerfstudio, a synthetic NeRF "
        "scene, LLFF, OpenSfM, ODM, Bundler, Metashape, RealityScan, Pix4D, ARKit or Polycam; they "
        "are not estimated.",
        panel="Known cameras",
        affects_output=False,  # its content does, and that is an input
    )
    split: bool = setting(
        False,
        "Use the split into training and test photographs of --cameras.",
        panel="Known cameras",
        needs="cameras",
    )
    refine_cameras: bool = setting(
        False,
        "Refine the poses of --cameras by bundle adjustment; intrinsics stay fixed.",
        panel="Known cameras",
        needs="cameras",
    )
    metres: bool = setting(
        False,
        "The poses of --cameras are in metres, as those of phones' AR sessions are.",
        panel="Units",
        needs="cameras",
    )
    scale: tuple[str, ...] = setting(
        (),
        "Two photographs and the distance between their cameras (metres).",
        panel="Units",
        together="A B METRES",
        midway=True,
    )
    marker: float = setting(
        0.0,
        "Side of the ArUco markers in the scene, alone or on a ChArUco board "
        "(metres); 0: there are none.",
        panel="Units",
        min=0.0,
        max=1000.0,
        midway=True,
    )
    crs: str = setting(
        "",
        "Turn a scene with GPS to this grid: a projected coordinate reference system in metres, "
        "such as EPSG:25832.",
        panel="Units",
        pattern=r"(EPSG:[0-9]{4,6})?",
        wanted="An EPSG code, such as EPSG:25832.",
        midway=True,
    )
    hold_out: bool = setting(
        True,
        "Hold out one photograph of every eight to measure quality on. Otherwise all are trained "
        "on, and quality is not measured.",
        panel="Quality and time",
        midway=True,
    )
    max_minutes: float = setting(
        120.0,
        "Stop with an error after this time (minutes).",
        min=0.1,
        max=100_000,
        affects_output=False,
    )


STAGE = Stage(
    "sfm",
    version=30,
    reads=("ingest",),
    settings_type=SfmSettings,
    adds="hold_out",
    **in_module("stages.sfm.stage"),
)
