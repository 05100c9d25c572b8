"""One training step by backend: forward pass, loss, backward pass, update.

`step` is the interface and the choice. `reference` is the readable step. `cpu`, `gpu` and `webgpu`
are the fast ones, by `loss_kernels`, `gpu_kernels` and `webgpu_loss`. `device_model` is what a
device gives to the rules between steps, and `webgpu_model` holds one for `webgpu`. `memory_limited`
continues with fewer splats.
"""
