"""Divides the wall time of a whole command (`--seconds`) among its stages.

Stages before training take what time they need; training and pruning end early, and leave time for
those after them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

# Of the time left when the stage begins. Pruning takes 0.4 x as long as training, if nothing stops
# it; quantising and export take 0.15 x as long as a whole `preview`, however short training was.
TIME_SHARES = {"train": 0.55, "prune": 0.5}
LEAST_S = 1.0  # seconds


def within_limit(stage: str, settings: Any, elapsed: float) -> Any:
    """The settings of a stage that begins `elapsed` seconds after the command. `seconds`, if set,
    is the limit of the command; the stage gets its share of what is left."""
    seconds = getattr(settings, "seconds", 0.0)
    if not seconds:
        return settings
    return replace(settings, seconds=max(LEAST_S, TIME_SHARES[stage] * (seconds - elapsed)))
