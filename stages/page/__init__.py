"""The page that shows splats in a browser: one document that needs nothing outside it.

The viewer in `vendor/` draws, orbits and flies. Our scripts in `parts/` add the cameras of the
capture, the photographs beside the picture, and figures.
"""
