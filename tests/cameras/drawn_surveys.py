"""Cameras as survey programs and phones export them, as in `drawn`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.cameras import drawn
from tests.cameras.drawn import (
    FOCAL,
    HEIGHT,
    K1,
    K2,
    NAMES,
    P1,
    P2,
    POSES,
    WIDTH,
    Project,
    draw,
    opengl_pose,
    radial_projection,
)

SHIFT = [-465_000.5, -5_246_000.25, -408.0]
UTM32 = 'PROJCRS["WGS 84 / UTM zone 32N",BASEGEOGCRS["WGS 84",ID["EPSG",4326]],ID["EPSG",32632]]'


def _pinhole(pose: NDArray[np.float64]) -> Project:
    """Of a camera to world, y up and z backward, with the principal point at 157, 123."""

    def project(points: NDArray[np.float64]) -> NDArray[np.float64]:
        at = (points - pose[:3, 3]) @ pose[:3, :3]
        d = at / -at[:, 2:]
        return np.stack([d[:, 0] * FOCAL + 157, -d[:, 1] * FOCAL + 123], axis=1)

    return project


def arkit(folder: Path) -> Path:
    """3D Scanner App: matrices by rows; a frame without picture between the others."""
    poses = [opengl_pose(pose) for pose in POSES]
    draw(folder, [_pinhole(pose) for pose in poses])
    for number, (name, pose) in enumerate(zip(NAMES, poses, strict=True)):
        (folder / name).rename(folder / f"frame_{6 * number:05}.png")
        frame = {
            "cameraPoseARFrame": pose.ravel().tolist(),
            "intrinsics": [FOCAL, 0, 156.5, 0, FOCAL, 122.5, 0, 0, 1],
            "time": 0.1 * number,
        }
        (folder / f"frame_{6 * number:05}.json").write_text(json.dumps(frame))
    (folder / "frame_00003.json").write_text(json.dumps(frame))
    return folder


def polycam(folder: Path) -> Path:
    """Polycam's keyframes: corrected cameras beside those of ARKit, which are off."""
    poses = [opengl_pose(pose) for pose in POSES]
    draw(folder / "keyframes" / "corrected_images", [_pinhole(pose) for pose in poses])
    draw(folder / "keyframes" / "images", [_pinhole(pose) for pose in poses])
    for kind, off in (("cameras", 0.3), ("corrected_cameras", 0.0)):
        (folder / "keyframes" / kind).mkdir()
        for name, pose in zip(NAMES, poses, strict=True):
            camera: dict[str, Any] = {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
            camera |= {"fx": FOCAL, "fy": FOCAL, "cx": 157, "cy": 123, "blur_score": 100.0}
            camera |= {"width": WIDTH, "height": HEIGHT}
            camera["t_03"] += off
            file = folder / "keyframes" / kind / name.replace(".png", ".json")
            file.write_text(json.dumps(camera))
    return folder


def realityscan_xmp(folder: Path) -> Path:
    """As the program's help describes it, once with attributes and once with elements; of the last
    photograph only the calibration is known."""
    draw(folder, [radial_projection(pose) for pose in POSES])
    for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True)):
        values = {
            "Rotation": pose[:3, :3].ravel(),
            "Position": -pose[:3, :3].T @ pose[:3, 3],
            "DistortionCoeficients": [K1, K2, 0, 0, 0, 0],
        }
        texts = {key: " ".join(map(repr, map(float, row))) for key, row in values.items()}
        inside = "".join(f"<xcr:{key}>{text}</xcr:{key}>" for key, text in texts.items())
        beside = " ".join(f'xcr:{key}="{text}"' for key, text in texts.items())
        (folder / name.replace(".png", ".xmp")).write_text(
            _xmp(beside, "") if number % 2 else _xmp("", inside), encoding="utf-8"
        )
    (folder / "unregistered.xmp").write_text(_xmp("", ""), encoding="utf-8")
    return folder


def _xmp(attributes: str, elements: str) -> str:
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
        'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" '
        'xcr:Coordinates="absolute" xcr:DistortionModel="brown3" xcr:AspectRatio="1" '
        f'xcr:FocalLength35mm="{FOCAL / WIDTH * 36!r}" xcr:PrincipalPointU="{3 / WIDTH!r}" '
        f'xcr:PrincipalPointV="{-3 / WIDTH!r}" {attributes}>{elements}'
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    )


def opf(folder: Path) -> Path:
    """As Pix4D's specification and its description of the perspective lens have it."""
    projects, cameras, listed = [], [], []
    for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True)):

        def project(points: NDArray[np.float64], pose: NDArray = pose) -> NDArray[np.float64]:
            at = points @ pose[:3, :3].T + pose[:3, 3]
            x, y = at[:, 0] / at[:, 2], at[:, 1] / at[:, 2]
            r2 = x * x + y * y
            radial = 1 + K1 * r2 + K2 * r2 * r2
            xd = x * radial + 2 * P1 * x * y + P2 * (r2 + 2 * x * x)
            yd = y * radial + 2 * P2 * x * y + P1 * (r2 + 2 * y * y)
            return np.stack([158 + FOCAL * xd, 122 + FOCAL * yd], axis=1)

        projects.append(project)
        to_world = opengl_pose(pose)
        r = to_world[:3, :3]  # Rx(omega) Ry(phi) Rz(kappa)
        angles = [
            np.arctan2(-r[1, 2], r[2, 2]),
            np.arcsin(r[0, 2]),
            np.arctan2(-r[0, 1], r[0, 0]),
        ]
        cameras.append(
            {
                "id": 2**63 + number,
                "sensor_id": 7,
                "position": to_world[:3, 3].tolist(),
                "orientation_deg": np.degrees(angles).tolist(),
            }
        )
        listed.append({"id": 2**63 + number, "uri": f"images/{name}"})
    draw(folder / "images", projects)
    internals = {"type": "perspective", "principal_point_px": [158, 122], "focal_length_px": FOCAL}
    internals |= {"radial_distortion": [K1, K2, 0], "tangential_distortion": [P1, P2]}
    frame = {"shift": SHIFT, "scale": [1, 1, 1], "swap_xy": False}
    parts: dict[str, tuple[str, dict[str, Any]]] = {
        "camera_list": ("camera-list", {"cameras": listed}),
        "input_cameras": (
            "input-cameras",
            {"sensors": [{"id": 7, "image_size_px": [WIDTH, HEIGHT]}], "captures": []},
        ),
        "scene_reference_frame": (
            "scene-reference-frame",
            {"crs": {"definition": UTM32}, "base_to_canonical": frame},
        ),
        "calibration": (
            "calibrated-cameras",
            {"cameras": cameras, "sensors": [{"id": 7, "internals": internals}]},
        ),
    }
    items = []
    for kind, (form, content) in parts.items():
        resource = {"uri": f"{form}.json", "format": f"application/opf-{form}+json"}
        resources = [resource, {"uri": "sparse.gltf", "format": "model/gltf+json"}]
        items.append({"id": kind, "type": kind, "resources": resources, "sources": []})
        (folder / f"{form}.json").write_text(
            json.dumps({"format": resource["format"], "version": "1.0", **content})
        )
    project_file = {"format": "application/opf-project+json", "version": "1.0", "items": items}
    (folder / "project.opf").write_text(json.dumps(project_file))
    return folder / "project.opf"


MADE = {
    **drawn.MADE,
    "arkit": arkit,
    "realityscan_xmp": realityscan_xmp,
    "opf": opf,
}
