"""`dropout.Dropout` on a device: the same splats rest, and the host is told nothing."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.training.dropout import FACTORS, FEW, LARGEST_SHARE, STRIDE, Dropout

_LOW = 0xFFFFFFFF  # 64-bit integers hold what 32-bit ones would overflow to


def dropped(dropout: Dropout, seen: Tensor) -> Tensor:
    """[N] bool: see `Dropout.resting`. seen [N] int32."""
    n = len(seen)
    if n == 0:
        return torch.zeros(0, dtype=torch.bool, device=seen.device)
    photographs = dropout.views * ((seen.double() + 1.0) / (seen.max() + 1.0))
    share = torch.square(FEW / photographs.clamp(min=1.0)).clamp(max=LARGEST_SHARE)
    return _noise(n, dropout.key, seen.device) < share * 2.0**32


def _noise(n: int, key: int, device: torch.device) -> Tensor:
    h = (torch.arange(n, device=device) * STRIDE + key) & _LOW
    for shift, factor in FACTORS:
        h = ((h ^ (h >> shift)) * factor) & _LOW
    return h ^ (h >> 16)
