"""A triangle mesh of the scene's surfaces: for engines that have to bump into something.

Depth drawn from the splats -> a signed distance field -> marching cubes -> fewer triangles. It is
a collision proxy: where things are, not how they look.
"""
