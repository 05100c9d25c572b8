"""The strategies by the names that a person may choose from; see `strategy`."""

from __future__ import annotations

from collections.abc import Callable

from stages.training.density import AdaptiveDensity
from stages.training.relocation import Relocation
from stages.training.strategy import Strategy

# Each is made from the scene's extent, world units, and the number of photographs in training.
STRATEGIES: dict[str, Callable[[float, int], Strategy]] = {
    "adaptive": AdaptiveDensity,
    "relocation": lambda extent, photographs: Relocation(extent),
}
