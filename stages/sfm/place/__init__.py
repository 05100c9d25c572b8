"""Up, scale, north and place of a reconstruction.

In reading order: `levelling` (up, from how cameras were held), `metric_scale` (which source of the
scale is used), `markers` (printed markers), `gps` (GPS positions), `crs` (grids of surveyors).
"""
