"""Cameras in each format that can be read, with photographs into which known points are drawn."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData, PlyElement

from stages.scene import look_at

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0
POINTS = np.random.default_rng(5).uniform(-0.6, 0.6, (12, 3))
COLOURS = np.random.default_rng(6).integers(60, 256, (12, 3)).astype(np.uint8)
EYES = np.array([[3.0, -1, 0.5], [0.3, 2.5, -1], [-2, -0.7, -2.2], [0.5, 0.2, 2.9]])
POSES = np.array([look_at(eye, np.zeros(3), np.array([0.1, 0.2, 1.0])) for eye in EYES])
K1, K2, P1, P2 = 0.08, -0.03, 0.004, -0.006
NAMES = [f"p_{number}.png" for number in range(len(POSES))]
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
CHUNK = (
    '<components><component id="0"><transform><rotation locked="true">0 -1 0 1 0 0 0 0 1</rotation>'
    '<translation locked="true">1 2 3</translation><scale locked="true">0.5</scale></transform>'
    '</component></components><reference>LOCAL_CS["Local Coordinates (m)",'
    'LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]</reference>'
)
Project = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def draw(folder: Path, projects: Sequence[Callable[..., NDArray[Any]]]) -> None:
    """A disc a point; nearer ones first, so that none is hidden by one drawn later."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, project in zip(NAMES, projects, strict=True):
        picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for (x, y), colour in zip(project(POINTS), COLOURS, strict=True):
            at = int(np.floor(x)), int(np.floor(y))
            cv2.circle(picture, at, 2, tuple(map(int, colour)), -1)
        Image.fromarray(picture).save(folder / name)


def opengl_pose(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera to world, y up and z backward."""
    return np.asarray(np.linalg.inv(OPENGL @ pose), np.float64)


def colmap(folder: Path) -> Path:
    """COLMAP itself draws and writes: a fisheye."""
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    lens = [FOCAL, FOCAL, 155, 124, 0.05, 0.01, 0.002, -0.001]
    camera = pycolmap.Camera(
        camera_id=1, model="OPENCV_FISHEYE", width=WIDTH, height=HEIGHT, params=lens
    )
    model.add_camera_with_trivial_rig(camera)
    projects = []
    for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True), 1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
        posed = model.images[number]
        projects.append(
            lambda points, posed=posed: np.array([posed.project_point(p) for p in points])
        )
    for point, colour in zip(POINTS, COLOURS, strict=True):
        model.add_point3D(point, pycolmap.Track(), colour)
    draw(folder / "images", projects)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    return folder


def nerfstudio(folder: Path) -> Path:
    """instant-ngp: y up, looking along -z, OpenCV's lens."""
    frames, projects = [], []
    for name, pose in zip(NAMES, POSES, strict=True):
        matrix = opengl_pose(pose)

        def project(points: NDArray[np.float64], matrix: NDArray = matrix) -> NDArray[np.float64]:
            at = (points - matrix[:3, 3]) @ matrix[:3, :3]
            x, y = at[:, 0] / -at[:, 2], -at[:, 1] / -at[:, 2]
            r2 = x * x + y * y
            radial = 1 + K1 * r2 + K2 * r2 * r2
            xd = x * radial + 2 * P1 * x * y + P2 * (r2 + 2 * x * x)
            yd = y * radial + 2 * P2 * x * y + P1 * (r2 + 2 * y * y)
            return np.stack([FOCAL * xd + 150, FOCAL * yd + 126], axis=1)

        projects.append(project)
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
    draw(folder / "images", projects)
    lens = {"fl_x": FOCAL, "cx": 150, "cy": 126, "k1": K1, "k2": K2, "p1": P1, "p2": P2}
    data = {"w": WIDTH, "h": HEIGHT, "camera_model": "OPENCV", **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder / "transforms.json"


def blender(folder: Path) -> Path:
    """NeRF's own loader: an angle of view, pictures without suffixes, one file a split."""
    angle = 2 * np.arctan(0.5 * WIDTH / FOCAL)
    projects: list[Project] = []
    frames = []
    for name, pose in zip(NAMES, POSES, strict=True):
        matrix = opengl_pose(pose)

        def project(points: NDArray[np.float64], matrix: NDArray = matrix) -> NDArray[np.float64]:
            # Rays of NeRF: d = ((i - W/2) / f, -(j - H/2) / f, -1) in the camera.
            at = (points - matrix[:3, 3]) @ matrix[:3, :3]
            d = at / -at[:, 2:]
            return np.stack([d[:, 0] * FOCAL + WIDTH / 2, -d[:, 1] * FOCAL + HEIGHT / 2], axis=1)

        projects.append(project)
        stem = name.removesuffix(".png")
        frames.append({"file_path": f"./train/{stem}", "transform_matrix": matrix.tolist()})
    draw(folder / "train", projects)
    for role, mine in (("train", frames[:2]), ("test", frames[2:3]), ("val", frames[3:])):
        data = {"camera_angle_x": angle, "frames": mine}
        (folder / f"transforms_{role}.json").write_text(json.dumps(data))
    return folder


def llff(folder: Path) -> Path:
    """Columns: down, right, backward, position, (height, width, focal length)."""
    rows, projects = [], []
    for pose in POSES:
        to_world = np.linalg.inv(pose)
        right, down, ahead, eye = to_world[:3].T

        def project(points: NDArray[np.float64], axes=(right, down, ahead, eye)):
            x, y, z = ((points - axes[3]) @ axis for axis in axes[:3])
            return np.stack([FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2], axis=1)

        projects.append(project)
        hwf = [HEIGHT, WIDTH, FOCAL]
        rows.append([*np.stack([down, right, -ahead, eye, hwf], axis=1).ravel(), 1.0, 9.0])
    draw(folder / "images", projects)
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def inria(folder: Path) -> Path:
    """The reference trainer's: camera to world, a pinhole."""
    entries, projects = [], []
    for number, (name, pose) in enumerate(zip(NAMES, POSES, strict=True)):
        to_world = np.linalg.inv(pose)

        def project(
            points: NDArray[np.float64], to_world: NDArray = to_world
        ) -> NDArray[np.float64]:
            at = (points - to_world[:3, 3]) @ to_world[:3, :3]
            return FOCAL * at[:, :2] / at[:, 2:] + (WIDTH / 2, HEIGHT / 2)

        projects.append(project)
        entries.append(
            {
                "id": number,
                "img_name": name,
                "width": WIDTH,
                "height": HEIGHT,
                "position": to_world[:3, 3].tolist(),
                "rotation": to_world[:3, :3].tolist(),
                "fy": FOCAL,
                "fx": FOCAL,
            }
        )
    draw(folder / "images", projects)
    (folder / "cameras.json").write_text(json.dumps(entries))
    channels = ("red", "green", "blue")
    kinds = [*((axis, "<f8") for axis in "xyz"), *((channel, "u1") for channel in channels)]
    rows = np.empty(len(POINTS), kinds)
    for name, values in zip(("x", "y", "z", *channels), (*POINTS.T, *COLOURS.T), strict=True):
        rows[name] = values
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "input.ply"))
    return folder / "cameras.json"


def opensfm(folder: Path) -> Path:
    """OpenCV draws: angle-axis rotations, OpenCV's lens."""
    side = max(WIDTH, HEIGHT)
    matrix = np.array([[FOCAL, 0, 158.0], [0, FOCAL * 1.02, 122.0], [0, 0, 1]])
    shots, projects = {}, []
    for name, pose in zip(NAMES, POSES, strict=True):
        turn, shift = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3]
        projects.append(
            lambda points, turn=turn, shift=shift: cv2.projectPoints(
                points, turn, shift, matrix, np.array([K1, K2, P1, P2])
            )[0][:, 0]
        )
        shots[name] = {
            "camera": "c",
            "rotation": turn.ravel().tolist(),
            "translation": shift.tolist(),
        }
    draw(folder / "images", projects)
    lens = {"k1": K1, "k2": K2, "p1": P1, "p2": P2, "k3": 0.0}
    lens |= {"focal_x": FOCAL / side, "focal_y": FOCAL * 1.02 / side}
    lens |= {"c_x": (158 - WIDTH / 2) / side, "c_y": (122 - HEIGHT / 2) / side}
    camera = {"projection_type": "brown", "width": WIDTH, "height": HEIGHT, **lens}
    points = {
        str(i): {"coordinates": p.tolist(), "color": c.tolist()}
        for i, (p, c) in enumerate(zip(POINTS, COLOURS, strict=True))
    }
    small = {"cameras": {"c": camera}, "shots": {}, "points": {}}
    data = [small, {"cameras": {"c": camera}, "shots": shots, "points": points}]
    (folder / "reconstruction.json").write_text(json.dumps(data))
    return folder / "reconstruction.json"


def bundler(folder: Path) -> Path:
    """The manual: P = R X + t, p = -P / P.z, p' = f r(p) p, from the middle, y up."""
    lines = ["# Bundle file v0.3", f"{len(POSES) + 1} {len(POINTS)}", *["0 0 0"] * 5]
    projects = []
    for pose in POSES:
        turned = OPENGL @ pose

        def project(points: NDArray[np.float64], turned: NDArray = turned) -> NDArray[np.float64]:
            at = points @ turned[:3, :3].T + turned[:3, 3]
            p = -at[:, :2] / at[:, 2:]
            r2 = (p * p).sum(axis=1, keepdims=True)
            x, y = (FOCAL * (1 + K1 * r2 + K2 * r2 * r2) * p).T
            return np.stack([WIDTH / 2 + x, HEIGHT / 2 - y], axis=1)

        projects.append(project)
        lines.append(f"{FOCAL} {K1} {K2}")
        lines += [" ".join(map(repr, map(float, row))) for row in turned[:3, :3]]
        lines.append(" ".join(map(repr, map(float, turned[:3, 3]))))
    for point, colour in zip(POINTS, COLOURS, strict=True):
        lines += [" ".join(map(repr, map(float, point))), " ".join(map(str, colour)), "1 0 0 1 1"]
    draw(folder, projects)
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("\n".join(["lost.png", *NAMES]) + "\n")
    return folder / "bundle.out"


def metashape(folder: Path) -> Path:
    """The manual: x' = x (1 + K1 r^2 + K2 r^4) + P1 (r^2 + 2 x^2) + 2 P2 x y, y' likewise,
    u = w / 2 + cx + x' f + x' B1 + y' B2, v = h / 2 + cy + y' f; camera to world, x right, y
    down."""
    cameras, projects = [], []
    for name, pose in zip(NAMES, POSES, strict=True):
        matrix = np.linalg.inv(pose)

        def project(points: NDArray[np.float64], pose: NDArray = pose) -> NDArray[np.float64]:
            at = points @ pose[:3, :3].T + pose[:3, 3]
            x, y = at[:, 0] / at[:, 2], at[:, 1] / at[:, 2]
            r2 = x * x + y * y
            radial = 1 + K1 * r2 + K2 * r2 * r2
            xd = x * radial + P1 * (r2 + 2 * x * x) + 2 * P2 * x * y
            yd = y * radial + P2 * (r2 + 2 * y * y) + 2 * P1 * x * y
            u = WIDTH / 2 + 3 + xd * FOCAL + xd * 5 + yd * 7
            return np.stack([u, HEIGHT / 2 - 4 + yd * FOCAL], axis=1)

        projects.append(project)
        words = " ".join(map(repr, map(float, matrix.ravel())))
        label = name.removesuffix(".png")
        cameras.append(
            f'<camera id="1" sensor_id="0" label="{label}"><transform>{words}</transform></camera>'
        )
    draw(folder, projects)
    lens = {"f": FOCAL, "cx": 3, "cy": -4, "b1": 5, "b2": 7, "k1": K1, "k2": K2, "p1": P1, "p2": P2}
    terms = "".join(f"<{key}>{value}</{key}>" for key, value in lens.items())
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk><sensors>'
        '<sensor id="0" type="frame"><calibration type="frame" class="adjusted">'
        f'<resolution width="{WIDTH}" height="{HEIGHT}"/>{terms}</calibration></sensor></sensors>'
        f'<cameras>{"".join(cameras)}<camera id="9" sensor_id="0" label="lost"/></cameras>'
        f"{CHUNK}</chunk></document>"
    )
    return folder / "cameras.xml"


def radial_projection(pose: NDArray[np.float64]) -> Callable[..., NDArray[Any]]:
    """The pixels of points through a lens with K1 and K2 and its principal point at (163, 117)."""

    def project(points: NDArray[np.float64]) -> NDArray[np.float64]:
        at = points @ pose[:3, :3].T + pose[:3, 3]
        x, y = at[:, 0] / at[:, 2], at[:, 1] / at[:, 2]
        r2 = x * x + y * y
        radial = 1 + K1 * r2 + K2 * r2 * r2
        return np.stack([163 + FOCAL * x * radial, 117 + FOCAL * y * radial], axis=1)

    return project


def realityscan(folder: Path) -> Path:
    """As nerfstudio and rc2nerf read it: heading and pitch of the picture's top, clockwise from
    north and above the horizon; roll about it; the lens in units of a 36 mm wide picture."""
    rows, projects = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"], []
    unit = 36 / max(WIDTH, HEIGHT)
    for name, pose in zip(NAMES, POSES, strict=True):
        right, down, ahead, eye = np.linalg.inv(pose)[:3].T
        pitch, heading = np.arcsin(-down[2]), np.arctan2(-down[0], -down[1])
        roll = np.arctan2(-right[2], -ahead[2])
        turns = np.degrees([heading, pitch, roll])
        projects.append(radial_projection(pose))
        lens = [FOCAL * unit, 3 * unit, -3 * unit, K1, K2, 0, 0, 0, 0]
        rows.append(",".join([name, *map(repr, map(float, [*eye, *turns, *lens]))]))
    draw(folder / "images", projects)
    (folder / "cameras.csv").write_text("\ufeff" + "\r\n".join(rows) + "\r\n", encoding="utf-8")
    return folder / "cameras.csv"


MADE = {
    "realityscan": realityscan,
    "metashape": metashape,
    "colmap": colmap,
    "nerfstudio": nerfstudio,
    "blender": blender,
    "llff": llff,
    "inria": inria,
    "opensfm": opensfm,
    "bundler": bundler,
}
