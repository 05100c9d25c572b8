"""The CPU backend: Numba kernels, the same bytes for any number of threads."""
