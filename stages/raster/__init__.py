"""The rasteriser: one definition and several backends (`backends`).

Read `definition` (settings, results, protocol), `tests/reference/definition.py` (the picture, in
torch, which tests hold every backend to) and `draw`. `camera_row` and `sh` are what every backend
reads. `backends` chooses between `cpu` and `gpu`. `smoothing` and `compensation` change splats so
that they are right when drawn smaller, or drawn plainly.
"""
