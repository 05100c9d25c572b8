"""Stage 5: removes splats and SH coefficients that the photographs do not need.

`stage` makes a `rounds.Pruner`, which removes splats in `rounds` until its `targets` are met;
`summary` reports the result. `settings` are the options.
"""
