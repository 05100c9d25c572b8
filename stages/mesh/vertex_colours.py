"""Vertex colours of the collision mesh, from the drawn views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from stages.mesh.depth_maps import DepthMap
from stages.scene.mesh import Mesh


def colour_vertices(mesh: Mesh, maps: list[DepthMap], tolerance: float) -> Mesh:
    """The mesh with colours: the weighted mean of the pixels that see each vertex.

    tolerance: the largest distance in depth between a pixel and a vertex that it sees, world units.
    A vertex that no pixel sees takes the colour of the nearest one that is seen.
    """
    if not len(mesh.vertices):
        return mesh
    sums, weights = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for depth_map in maps:
        camera = depth_map.camera
        pixels, z = camera.project(mesh.vertices.astype(np.float64))
        inside = (z > 0) & camera.shows(pixels)
        columns, rows = pixels[inside].astype(int).T
        agrees = np.abs(depth_map.depth[rows, columns] - z[inside]) < tolerance
        seen = np.flatnonzero(inside)[agrees]
        rows, columns = rows[agrees], columns[agrees]
        weight = depth_map.weight[rows, columns].astype(np.float64)
        sums[seen] += weight[:, None] * depth_map.colour[rows, columns]
        weights[seen] += weight
    known = weights > 0
    if not known.any():
        return mesh
    colours = np.zeros((len(weights), 3))
    colours[known] = sums[known] / weights[known, None]
    _, nearest = cKDTree(mesh.vertices[known]).query(mesh.vertices[~known])
    colours[~known] = colours[known][nearest]
    return replace(mesh, colours=np.rint(colours).astype(np.uint8))
