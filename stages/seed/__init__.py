"""Stage 3: `Reconstruction` -> the first `Splats`: at sparse points, and where there are none.

In reading order: `settings`, `stage`, `view_selection` (which views are used), `plane_sweep` and
`measured_depth` (more points), `empty_cells` (splats where there are still none), `visibility`
(may a surface be there?), `colour_evidence` (where else?), `axes` (rotations), `projection` and
`neighbours`; `given` and `worlds` (splats that were trained before), `uncovered` (where these
leave pictures transparent).
"""
