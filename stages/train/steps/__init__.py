"""One training step by backend: forward pass, loss, backward pass and Adam.

`step` is the interface and the choice. `reference` is the readable step, `cpu` and `gpu` are the
fast ones, by `loss_kernels` and `gpu_kernels`. `device_model` is what `gpu` gives to the rules
between steps. `webgpu_loss` is the loss on a WebGPU device. `memory_limited` continues with
fewer splats.
"""
