"""What to try, and whether the result is good enough.

In reading order: `circular_fisheye`, `same_place` (looks before the search), `fallbacks` (the
configurations and their order), `attempt_runner` (runs one), `statistics` (measures its model),
`gates` (thresholds, and the errors behind them), `acceptance` (which attempt is used, and what is
reported about it).
"""
