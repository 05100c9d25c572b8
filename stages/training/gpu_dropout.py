"""`dropout.Dropout` on a device: drops the same splats, without a transfer to the host."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.training.dropout import FACTORS, INCREMENT, MAX_PROBABILITY, VIEW_SCALE, Dropout

_LOW = 0xFFFFFFFF  # products are computed in 64-bit integers, which hold what 32-bit ones overflow


def dropped(dropout: Dropout, counts: Tensor) -> Tensor:
    """[N] bool: see `Dropout.dropped`. counts [N] int32."""
    n = len(counts)
    if n == 0:
        return torch.zeros(0, dtype=torch.bool, device=counts.device)
    seen_by = dropout.views * ((counts.double() + 1.0) / (counts.max() + 1.0))
    probability = torch.square(VIEW_SCALE / seen_by.clamp(min=1.0)).clamp(max=MAX_PROBABILITY)
    return _noise(n, dropout.key, counts.device) < probability * 2.0**32


def _noise(n: int, key: int, device: torch.device) -> Tensor:
    h = (torch.arange(n, device=device) * INCREMENT + key) & _LOW
    for shift, factor in FACTORS:
        h = ((h ^ (h >> shift)) * factor) & _LOW
    return h ^ (h >> 16)
