"""One training step by backend: forward pass, loss, backward pass and Adam.

`step` is the interface and the choice. `reference` is the readable step, `cpu` and `gpu` are the
fast ones, by `loss_kernels` and `gpu_kernels`. `device_model` is what `gpu` gives to the rules
between steps. `memory_limited` continues with fewer splats.
"""
