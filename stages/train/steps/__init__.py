"""One training step by backend: forward pass, loss, backward pass and Adam.

`step` is the interface and the choice. `cpu` and `gpu` are the steps, by `loss_kernels` and
`gpu_kernels`; `tests/reference/step.py` is a readable one, from the definitions. `device_model` is
what `gpu` gives to the rules between steps. `memory_limited` continues with fewer splats.
"""
