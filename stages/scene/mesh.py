"""The mesh type: triangles with vertex colours."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stages.scene.place import EarthPlace

NOTE = "collision proxy: where surfaces are, for physics; not made to be looked at"


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: [V, 3] float32 in the world (y down), relative to `origin`.
        faces: [F, 3] int32, counterclockwise seen from the cameras.
        colours: [V, 3] uint8, sRGB.
        origin, place: as in `Splats`.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    colours: NDArray[np.uint8]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    place: EarthPlace | None = None

    @classmethod
    def of(cls, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> Mesh:
        """A grey mesh without degenerate faces and without vertices that no face uses."""
        vertices = np.ascontiguousarray(vertices, np.float32)
        corners = vertices[faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        faces = faces[np.any(across != 0, axis=1)]
        used, renamed = np.unique(faces, return_inverse=True)
        grey = np.full((len(used), 3), 128, np.uint8)
        return cls(vertices[used], renamed.reshape(-1, 3).astype(np.int32), grey)

    @classmethod
    def empty(cls) -> Mesh:
        return cls.of(np.zeros((0, 3)), np.zeros((0, 3), np.int32))

    def normals(self) -> NDArray[np.float32]:
        """[V, 3] unit normals: means over the adjacent faces, weighted by area."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(np.float64) for i in range(3))
        across = np.cross(b - a, c - a)
        sums = np.zeros((len(self.vertices), 3))
        for i in range(3):
            for axis in range(3):
                found = np.bincount(self.faces[:, i], across[:, axis], len(sums))
                sums[:, axis] += found
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        up = np.array([0.0, -1.0, 0.0])  # where the adjacent faces cancel each other
        return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), up).astype(
            np.float32
        )

    @property
    def is_watertight(self) -> bool:
        """Whether every edge belongs to two faces with opposite directions."""
        if not len(self.faces):
            return False
        edges = self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
        there = edges[:, 0] * len(self.vertices) + edges[:, 1]
        back = edges[:, 1] * len(self.vertices) + edges[:, 0]
        unique = np.unique(there)
        return bool(len(unique) == len(there) and np.array_equal(unique, np.unique(back)))
