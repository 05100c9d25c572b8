"""A reconstruction on disk: reconstruction.json (views) and .npy arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from stages.base.atomic import replacing
from stages.base.bad_files import reading, stage_output
from stages.scene import Camera, Reconstruction, View
from stages.scene.place import EarthPlace

FILE_NAME = "reconstruction.json"
_FILE_WORLD = "file_from_world"
_INTRINSICS = ("fx", "fy", "cx", "cy")
_ARRAYS = {"points": "<f8", "colours": "|u1", "errors_px": "<f8", "tracks": "<i4"}


def save_reconstruction(folder: Path, reconstruction: Reconstruction) -> None:
    """Write everything but the pictures; reconstruction.json is written last. Floats round-trip
    exactly."""
    for name, dtype in _ARRAYS.items():
        array = np.ascontiguousarray(getattr(reconstruction, name), dtype)
        with replacing(folder / f"{name}.npy") as path, path.open("wb") as file:
            np.lib.format.write_array(file, array, version=(1, 0), allow_pickle=False)
    data = {
        "format": 1,
        "units": reconstruction.units,
        "levelled": reconstruction.levelled,
        "contradicted": reconstruction.contradicted,
        "origin": [float(value) for value in reconstruction.origin],
        **({} if reconstruction.place is None else {"place": reconstruction.place.to_json()}),
        **_file_world(reconstruction),
        "points": len(reconstruction.points),
        "views": [_view_to_dict(view) for view in reconstruction.views],
    }
    with replacing(folder / FILE_NAME) as path:
        path.write_text(json.dumps(data, indent=1, ensure_ascii=False), encoding="utf-8")


def load_reconstruction(folder: Path) -> Reconstruction:
    """Read what `save_reconstruction` wrote; pictures are not opened.

    Raises SplatError "reconstruction-damaged" if something is missing or inconsistent.
    """
    with reading(folder / FILE_NAME, stage_output("reconstruction-damaged")):
        data = json.loads((folder / FILE_NAME).read_text(encoding="utf-8"))
        arrays = {name: _load_array(folder, name, dtype) for name, dtype in _ARRAYS.items()}
        count = int(data["points"])
        if any(len(array) != count for array in arrays.values()):
            raise ValueError("its arrays differ in length")
        return Reconstruction(
            folder=folder,
            views=tuple(_view_from_dict(dict(view)) for view in data["views"]),
            origin=np.array(data["origin"], np.float64).reshape(3),
            units=str(data["units"]),
            place=EarthPlace.from_json(data["place"]) if "place" in data else None,
            levelled=bool(data["levelled"]),
            contradicted=bool(data.get("contradicted", False)),
            file_from_world=(
                np.array(data[_FILE_WORLD], np.float64).reshape(4, 4)
                if _FILE_WORLD in data
                else None
            ),
            **arrays,
        )


def _file_world(reconstruction: Reconstruction) -> dict[str, Any]:
    to_file = reconstruction.file_from_world
    return {} if to_file is None else {_FILE_WORLD: to_file.tolist()}


def _load_array(folder: Path, name: str, dtype: str) -> Any:
    array = np.load(folder / f"{name}.npy", allow_pickle=False)
    width = () if name in ("errors_px", "tracks") else (3,)
    if array.dtype != np.dtype(dtype) or array.shape[1:] != width or not array.ndim:
        raise ValueError(f"{name}.npy has another data type or shape")
    return array


def _view_to_dict(view: View) -> dict[str, Any]:
    camera = view.camera
    return {
        "name": view.name,
        "image": view.image,
        "duplicate_of": view.duplicate_of,
        **({"role": view.role} if view.role else {}),
        **({"mask": view.mask, "outside": view.outside} if view.mask else {}),
        **({"depth": view.depth} if view.depth else {}),
        **({"light": list(view.light)} if view.light else {}),
        **({"frame": view.frame} if view.frame else {}),
        "width": camera.width,
        "height": camera.height,
        **{name: float(getattr(camera, name)) for name in _INTRINSICS},
        "world_to_camera": camera.world_to_camera.tolist(),
    }


def _view_from_dict(data: dict[str, Any]) -> View:
    matrix = np.array(data.pop("world_to_camera"), np.float64).reshape(4, 4)
    numbers = {name: data.pop(name) for name in ("width", "height", *_INTRINSICS)}
    camera = Camera(**numbers, world_to_camera=matrix)
    if "light" in data:
        data["light"] = tuple(data["light"])
    data.pop("vignetting", None)  # of earlier versions
    return View(camera=camera, **data)
