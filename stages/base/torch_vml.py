"""The first calls of oneMKL's vector functions, made before several threads make them.

torch computes exp, log, sqrt, sin and cos of long CPU tensors with oneMKL, each thread a part. In
the oneMKL 2024.2 of torch's wheels, a first call by several threads at once may choose a kernel of
low accuracy in one of them (pytorch issue 188792): half of a float64 tensor then has relative
errors of 3e-9, and a run is not repeatable. After one call by one thread the choice is made.
"""

from __future__ import annotations


def warm_up() -> None:
    """Call each function that the project uses once, in both precisions. Imports torch."""
    import torch

    for dtype in (torch.float32, torch.float64):
        one = torch.ones(1, dtype=dtype)
        for function in (torch.exp, torch.log, torch.sqrt, torch.sin, torch.cos):
            function(one)
