"""Support for compiled kernels: vector types, threads, and the cache of compiled code."""

from stages.raster.kernels import cache

cache.prepare()  # before Numba is imported, which reads the environment
