"""The GPU backend: Triton kernels, as `definition.Rasteriser` wants them. See docs/guide/gpu.md."""
