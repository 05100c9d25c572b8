"""The rasteriser: one definition (`reference`) and several backends (`backends`).

Read `definition` (settings, results, protocol), then `reference` (the picture, in torch) and
`draw`. `camera_row` and `sh` are what every backend reads. `backends` chooses among `cpu`, `gpu`
and `reference_rasteriser`. `smoothing` and `compensation` change splats so that they are right when
drawn smaller, or drawn plainly. `similarity` moves splats and cameras together.
"""
