"""Checks of the files that options name, before photographs are read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stages.cameras.camera_formats import read_cameras
from stages.seed.settings import check_given
from stages.sfm.known.match_cameras import check_split


def check_files(settings: Mapping[str, Any]) -> None:
    """Raise SplatError for known cameras and given splats that no run could use. settings: by
    stage name."""
    sfm, splats = settings["sfm"], settings["seed"].splats
    if sfm.cameras is not None:
        check_split(read_cameras(sfm.cameras), sfm.split)
    if splats is not None:
        check_given(splats, has_cameras=sfm.cameras is not None)
