"""The WebGPU backend: WGSL kernels that run through Vulkan, Metal or Direct3D 12, with the protocol
`definition.Rasteriser`.

In the order of a picture: `rasteriser` runs project.wgsl with geometry.wgsl, then lists.wgsl
between the sorts of sort.wgsl and scan.wgsl, then blend.wgsl; sums.wgsl and gradients.wgsl end the
backward pass. `device` finds the adapter, holds buffers and records dispatches.
"""
