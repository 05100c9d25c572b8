"""The CPU backend: Numba kernels that give the same bytes for any number of threads.

In the order of a picture: `rasteriser` calls `splat_kernels` with `projection` and `sh_kernels`,
then `binning`, then `blend` on a `tile`. `contributions` is the pass that measures splats.
"""
