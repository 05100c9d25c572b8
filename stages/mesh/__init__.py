"""The collision mesh: triangles of the scene's surfaces, for physics in game engines.

Depth maps drawn from the splats -> truncated signed distance field -> marching cubes ->
simplification.
"""
