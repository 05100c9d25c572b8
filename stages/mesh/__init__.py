"""The collision mesh: triangles of the scene's surfaces, for physics in game engines.

Depth maps drawn from the splats -> truncated signed distance field -> marching cubes ->
simplification.

In this order: `collision_mesh` calls `depth_maps`, `fuse` (with `fuse_kernels`), `extract` and
`vertex_colours`.
"""
