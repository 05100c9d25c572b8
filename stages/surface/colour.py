"""What colour the cameras saw at each vertex."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.surface.depth_maps import DepthMap
from stages.surface.mesh import Mesh


def colour_vertices(mesh: Mesh, maps: list[DepthMap], tolerance: float) -> Mesh:
    """Each vertex in the mean of what the pixels show that see it, by their votes.

    tolerance: how far a pixel's depth may lie from the vertex, world units. What no pixel sees
    takes the colour of the nearest vertex that one does.
    """
    from scipy.spatial import cKDTree

    if not len(mesh.vertices):
        return mesh
    sums, votes = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for found in maps:
        camera = found.camera
        pixels, z = camera.project(mesh.vertices.astype(np.float64))
        inside = (z > 0) & camera.shows(pixels)
        columns, rows = pixels[inside].astype(int).T
        agrees = np.abs(found.depth[rows, columns] - z[inside]) < tolerance
        seen = np.flatnonzero(inside)[agrees]
        rows, columns = rows[agrees], columns[agrees]
        weight = found.weight[rows, columns].astype(np.float64)
        sums[seen] += weight[:, None] * found.colour[rows, columns]
        votes[seen] += weight
    known = votes > 0
    if not known.any():
        return mesh
    colours = np.zeros((len(votes), 3))
    colours[known] = sums[known] / votes[known, None]
    _, nearest = cKDTree(mesh.vertices[known]).query(mesh.vertices[~known])
    colours[~known] = colours[known][nearest]
    return replace(mesh, colours=np.rint(colours).astype(np.uint8))
