"""The page that shows splats in a browser: one document that needs nothing outside it.

The viewer in `vendor/` draws, orbits and flies; what is ours, in `parts/`, adds the capture's
cameras, the photographs beside the picture, and figures.
"""
