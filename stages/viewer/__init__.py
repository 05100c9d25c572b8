"""A page to look at splats with, and a server of this machine only that shows it.

The viewer in `vendor/` draws, orbits and flies; what is ours adds the capture's cameras, the
photographs beside the picture, and figures.
"""
