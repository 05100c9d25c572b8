"""The WebGPU backend: WGSL kernels that run through Vulkan, Metal or Direct3D 12, with the protocol
`definition.Rasteriser`.

`device` finds the adapter, holds buffers and records dispatches.
"""
