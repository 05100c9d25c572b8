"""The CPU backend: Numba kernels that give the same bytes for any number of threads."""
