"""The GPU backend: Triton kernels with the protocol `definition.Rasteriser` (docs/guide/gpu.md).

In the order of a picture: `rasteriser` calls `project` with `geometry`, then `lists`, then `blend`;
`gradients` ends the backward pass. `inner` has functions that kernels share, `device` finds the
GPU.
"""
