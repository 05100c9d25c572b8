"""What compiled kernels stand on: vectors, threads, and where they are kept."""

from stages.raster.kernels import cache

cache.prepare()  # before Numba, which is told by the environment
