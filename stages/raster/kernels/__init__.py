"""Support for compiled kernels: vector types, threads, and the cache of compiled code.

`pool` runs kernels in threads, `cache` keeps compiled ones, `simd`, `simd32` and `simd64` are the
vectors that they compute with, which `vectors` defines.
"""

from stages.raster.kernels import cache

cache.prepare()  # before Numba is imported, which reads the environment
