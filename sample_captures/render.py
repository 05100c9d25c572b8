"""A small ray caster: textured boxes, cylinders and ellipsoids under soft light.

World y points down, as everywhere in this project. Light comes from a disc (the key light, soft
shadows) and from a dome of directions. Their sample points are fixed in the world and shared out
among the sub-samples of a pixel: shading has no noise and looks the same from every view, except
for the highlights, which follow the viewer (Blinn 1977, "Models of light reflection for computer
synthesized pictures").
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

SUPERSAMPLING = 3  # per axis
LIGHT_SAMPLES = 4  # key and dome samples per sub-sample; 36 of each per pixel


@dataclass(frozen=True)
class Shape:
    """kind: "box", "cylinder" (along y, capped) or "ellipsoid"; half [3]: half sizes in metres.

    faces: textures [H, W, 3] in 0..1 (sRGB). box: -x +x -y +y -z +z; cylinder: side, top, bottom;
    ellipsoid: one. inside: seen from within (the room). upside_down: turned by half a turn about
    the world's x. gloss: strength of the highlight.
    """

    kind: str
    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    faces: tuple[Array, ...]
    yaw_degrees: float = 0.0
    gloss: float = 0.0
    shininess: float = 80.0
    inside: bool = False
    upside_down: bool = False

    def to_local(self) -> Array:
        """[3, 3] from world directions to the frame in which the shape has half size 1."""
        angle = np.radians(self.yaw_degrees)
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        if self.upside_down:  # after the yaw
            rotation = rotation @ np.diag([1, -1, -1])
        return (rotation / np.array(self.half)[:, None]).astype(np.float32)


@dataclass(frozen=True)
class Lens:
    """COLMAP's SIMPLE_RADIAL: pixel = f (1 + k r^2) (x, y) / z + c; pixel centres at +0.5."""

    width: int
    height: int
    focal_px: float
    k: float

    def rays(self, world_to_camera: NDArray[np.float64], dx: float, dy: float) -> Array:
        """[3, H W] unit directions in the world through the points (dx, dy) of each pixel."""
        u, v = np.meshgrid(np.arange(self.width) + dx, np.arange(self.height) + dy)
        distorted = np.stack([u - self.width / 2, v - self.height / 2]).reshape(2, -1)
        distorted = distorted / self.focal_px
        flat = distorted.copy()
        for _ in range(12):  # fixed point of the distortion; contracts by about 3 |k| r^2
            flat = distorted / (1 + self.k * (flat**2).sum(0))
        camera = np.concatenate([flat, np.ones((1, flat.shape[1]))])
        world = world_to_camera[:3, :3].T @ camera
        return (world / np.linalg.norm(world, axis=0)).astype(np.float32)


def interval(kind: str, o: Array, d: Array) -> tuple[Array, Array]:
    """Entry and exit distances [N] of rays o + t d with the unit shape; entry > exit: a miss."""
    d = np.where(np.abs(d) < 1e-9, np.float32(1e-9), d)
    if kind == "box":
        a, b = (-1 - o) / d, (1 - o) / d
        return np.minimum(a, b).max(0), np.maximum(a, b).min(0)
    axes = slice(None) if kind == "ellipsoid" else slice(0, 3, 2)
    aa = (d[axes] ** 2).sum(0)
    half_b = (o[axes] * d[axes]).sum(0)
    disc = half_b**2 - aa * ((o[axes] ** 2).sum(0) - 1)
    root = np.sqrt(np.maximum(disc, 0))
    near = np.where(disc > 0, (-half_b - root) / aa, np.float32(np.inf))
    far = np.where(disc > 0, (-half_b + root) / aa, np.float32(-np.inf))
    if kind == "ellipsoid":
        return near, far
    a, b = (-1 - o[1]) / d[1], (1 - o[1]) / d[1]
    return np.maximum(near, np.minimum(a, b)), np.minimum(far, np.maximum(a, b))


def hit(shape: Shape, origins: Array, directions: Array) -> Array:
    """[N] distance to the surface, inf where missed. origins [3, N] or [3, 1]."""
    matrix = shape.to_local()
    o = matrix @ (origins - np.array(shape.centre, np.float32)[:, None])
    near, far = interval(shape.kind, o, matrix @ directions)
    t = far if shape.inside else near
    return np.where((near < far) & (t > 1e-4), t, np.float32(np.inf))


def surface(shape: Shape, points: Array) -> tuple[Array, Array]:
    """World normals [3, N] and sRGB colours [3, N] at points [3, N] on the shape."""
    matrix = shape.to_local()
    p = matrix @ (points - np.array(shape.centre, np.float32)[:, None])
    x, y, z = p
    around = (np.arctan2(z, x) / (2 * np.pi)).astype(np.float32) % 1
    if shape.kind == "ellipsoid":
        normal, face = p, np.zeros(len(x), np.int64)
        u, v = around, np.arccos(np.clip(y, -1, 1)) / np.pi
    elif shape.kind == "cylinder":
        cap = x**2 + z**2 < y**2
        normal = np.where(cap, np.stack([0 * x, np.sign(y), 0 * x]), np.stack([x, 0 * y, z]))
        face = np.where(cap, np.where(y < 0, 1, 2), 0)
        u = np.where(cap, (x + 1) / 2, around)
        v = np.where(cap, (1 + np.sign(y) * z) / 2, (y + 1) / 2)
    else:
        axis = np.abs(p).argmax(0)
        along = np.take_along_axis(p, axis[None], 0)[0]
        normal = np.where(np.arange(3)[:, None] == axis, np.sign(along), 0)
        face = 2 * axis + (along > 0)
        side = np.where(shape.inside, -np.sign(along), np.sign(along))  # unmirrored on each face
        u = (np.choose(axis, [side * z, x, -side * x]) + 1) / 2
        v = (np.where(axis == 1, side * z, y) + 1) / 2
    colour = np.zeros_like(p)
    for index in np.unique(face):
        rows = np.nonzero(face == index)[0]
        colour[:, rows] = lookup(shape.faces[index], u[rows], v[rows])
    world = matrix.T @ (-normal if shape.inside else normal).astype(np.float32)
    return world / np.linalg.norm(world, axis=0), colour


def lookup(texture: Array, u: Array, v: Array) -> Array:
    """[3, N] bilinear texture values at u, v in 0..1."""
    height, width = texture.shape[:2]
    columns = (u * width - 0.5).astype(np.float32)
    rows = (v * height - 0.5).astype(np.float32)
    side = 1 << 14  # remap takes at most 32767 columns
    pad = (-len(columns)) % side
    grids = [np.pad(g, (0, pad)).reshape(-1, side) for g in (columns, rows)]
    values = cv2.remap(
        texture, grids[0], grids[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(values.reshape(-1, 3)[: len(columns)].T, np.float32)


def occluded(
    shapes: list[Shape], origins: Array, directions: Array, reach: Array
) -> NDArray[np.bool_]:
    """[N] whether anything but the room lies between the origins and `reach` [N] along the ray."""
    blocked = np.zeros(origins.shape[1], bool)
    for shape in shapes:
        if not shape.inside:
            blocked |= hit(shape, origins, directions) < reach
    return blocked


def spiral(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Radii in 0..1 and angles of points spread evenly over a disc (Vogel 1979)."""
    index = np.arange(count) + 0.5
    return np.sqrt(index / count), index * np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Light:
    """The key light: a disc of `radius` at `position`, and a dome. Strengths are for white."""

    position: tuple[float, float, float] = (1.5, -2.3, -1.7)
    radius: float = 0.30
    key: tuple[float, float, float] = (1.75, 1.56, 1.32)
    dome: tuple[float, float, float] = (0.33, 0.37, 0.43)
    bounce: tuple[float, float, float] = (0.10, 0.09, 0.08)

    def samples(self, part: int, parts: int) -> tuple[Array, Array]:
        """Key positions [3, n] and dome directions [3, n] of one of `parts` shares."""
        radius, angle = spiral(LIGHT_SAMPLES * parts)
        plane = np.stack([radius * np.cos(angle), 0 * radius, radius * np.sin(angle)])
        key = np.array(self.position)[:, None] + self.radius * plane
        up = np.sqrt(1 - (radius * 0.98) ** 2)  # cosine-weighted about -y
        dome = np.stack([0.98 * plane[0], -up, 0.98 * plane[2]])
        return key[:, part::parts].astype(np.float32), dome[:, part::parts].astype(np.float32)


def shade(
    shapes: list[Shape], light: Light, eye: Array, directions: Array, part: int, parts: int
) -> Array:
    """[3, N] linear light along rays from `eye` [3]."""
    distances = np.stack([hit(shape, eye[:, None], directions) for shape in shapes])
    nearest = distances.argmin(0)
    points = eye[:, None] + directions * distances.min(0)
    normals, albedo = np.zeros_like(points), np.zeros_like(points)
    gloss, shininess = (np.zeros(points.shape[1], np.float32) for _ in range(2))
    for index, shape in enumerate(shapes):
        rows = np.nonzero(nearest == index)[0]
        if len(rows):
            normals[:, rows], colour = surface(shape, points[:, rows])
            albedo[:, rows] = srgb_to_linear(colour)
            gloss[rows], shininess[rows] = shape.gloss, shape.shininess
    start = points + normals * 1.5e-3
    diffuse = np.array(light.bounce, np.float32)[:, None] * np.ones_like(points)
    shine = np.zeros(points.shape[1], np.float32)
    key_points, dome = light.samples(part, parts)
    for sample in key_points.T:
        to_light = sample[:, None] - start
        reach = np.linalg.norm(to_light, axis=0)
        to_light = to_light / reach
        lit = ~occluded(shapes, start, to_light, reach)
        cosine = np.maximum((normals * to_light).sum(0), 0) * lit
        fade = (3.1 / (1.1 + reach)) ** 1.5
        diffuse += np.array(light.key, np.float32)[:, None] * (cosine * fade / LIGHT_SAMPLES)
        half = to_light - directions
        half = half / np.linalg.norm(half, axis=0)
        blinn = np.maximum((normals * half).sum(0), 0) ** shininess
        shine += gloss * blinn * lit * (cosine > 0) / LIGHT_SAMPLES
    far = np.full(points.shape[1], 100, np.float32)
    for direction in dome.T:
        to_light = np.broadcast_to(direction[:, None], points.shape)
        cosine = np.maximum((normals * to_light).sum(0) * 0.5 + 0.5, 0)  # wide: sky and walls
        open_sky = ~occluded(shapes, start, to_light, far)
        diffuse += np.array(light.dome, np.float32)[:, None] * (cosine * open_sky / LIGHT_SAMPLES)
    return albedo * diffuse + shine


def photograph(
    shapes: list[Shape], light: Light, lens: Lens, world_to_camera: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """[H, W, 3] 8-bit sRGB picture, averaged over the sub-samples in linear light."""
    eye = (-world_to_camera[:3, :3].T @ world_to_camera[:3, 3]).astype(np.float32)
    parts = SUPERSAMPLING**2
    total = np.zeros((3, lens.width * lens.height), np.float32)
    for part in range(parts):
        dx = (part % SUPERSAMPLING + 0.5) / SUPERSAMPLING
        dy = (part // SUPERSAMPLING + 0.5) / SUPERSAMPLING
        linear = shade(shapes, light, eye, lens.rays(world_to_camera, dx, dy), part, parts)
        total += np.minimum(linear, 1.5) / parts  # limits the jaggies of clipped highlights
    picture = linear_to_srgb(total).T.reshape(lens.height, lens.width, 3)
    return np.round(picture * 255).astype(np.uint8)


def srgb_to_linear(value: Array) -> Array:
    """IEC 61966-2-1."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: Array) -> Array:
    """IEC 61966-2-1, clipped to 0..1."""
    value = np.clip(value, 0, 1)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)
