"""Matches of learned features by LighterGlue: LightGlue (Lindenberger et al. 2023) for XFeat.

A transformer over the features of both photographs. Its weights lie beside those of XFeat.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from stages.sfm.learned.features import LearnedFeatures, weights
from stages.sfm.learned.weights import LIGHTERGLUE

LAYERS = 6
LEAST_PROBABILITY = 0.1  # of a match, as LightGlue's authors have it
_PREFIX = "matcher."


class LighterGlue:
    """The network; several threads may use it at once."""

    def __init__(self) -> None:
        stored = weights(LIGHTERGLUE)
        self._weights = {
            name.removeprefix(_PREFIX): value
            for name, value in stored.items()
            if name.startswith(_PREFIX)
        }

    @torch.inference_mode()
    def matches(self, first: LearnedFeatures, second: LearnedFeatures) -> NDArray[np.uint32]:
        """[M, 2] indices of features that match, sorted; each feature is in one match at most."""
        if not len(first.points) or not len(second.points):
            return np.empty((0, 2), np.uint32)
        a, b = (self._linear("input_proj", each.descriptors) for each in (first, second))
        turn_a, turn_b = (self._rotations(each.normalised) for each in (first, second))
        for layer in range(LAYERS):
            name = f"transformers.{layer}"
            a = self._attend_self(f"{name}.self_attn", a, turn_a)
            b = self._attend_self(f"{name}.self_attn", b, turn_b)
            a, b = self._attend_other(f"{name}.cross_attn", a, b)
        scores = self._log_probabilities(f"log_assignment.{LAYERS - 1}", a, b)
        best, there = scores.max(1)
        back = scores.argmax(0)
        here = torch.arange(len(there))
        sure = (back[there] == here) & (best > np.log(LEAST_PROBABILITY))
        return torch.stack((here[sure], there[sure]), 1).numpy().astype(np.uint32)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        return functional.linear(
            x, self._weights[f"{name}.weight"], self._weights.get(f"{name}.bias")
        )

    def _rotations(self, normalised: Tensor) -> tuple[Tensor, Tensor]:
        """Cosines and sines [N, C] of the rotary encoding of positions, each for two channels."""
        angles = self._linear("posenc.Wr", normalised)
        cosines, sines = (
            values.repeat_interleave(2, dim=1) for values in (angles.cos(), angles.sin())
        )
        return cosines, sines

    def _attend_self(self, name: str, x: Tensor, turn: tuple[Tensor, Tensor]) -> Tensor:
        """x [N, C] after attention to the features of its own photograph."""
        query, key, value = self._linear(f"{name}.Wqkv", x).reshape(len(x), -1, 3).unbind(2)
        message = _attention(_rotated(query, turn), _rotated(key, turn), value)
        return self._updated(name, x, self._linear(f"{name}.out_proj", message))

    def _attend_other(self, name: str, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """a [N, C] and b [M, C] after attention to the features of the other photograph."""
        (key_a, value_a), (key_b, value_b) = (
            (self._linear(f"{name}.to_qk", x), self._linear(f"{name}.to_v", x)) for x in (a, b)
        )
        to_a, to_b = (
            self._linear(f"{name}.to_out", message)
            for message in (_attention(key_a, key_b, value_b), _attention(key_b, key_a, value_a))
        )
        return self._updated(name, a, to_a), self._updated(name, b, to_b)

    def _updated(self, name: str, x: Tensor, message: Tensor) -> Tensor:
        hidden = self._linear(f"{name}.ffn.0", torch.cat((x, message), 1))
        scale, shift = (self._weights[f"{name}.ffn.1.{part}"] for part in ("weight", "bias"))
        hidden = functional.gelu(functional.layer_norm(hidden, scale.shape, scale, shift))
        return x + self._linear(f"{name}.ffn.3", hidden)

    def _log_probabilities(self, name: str, a: Tensor, b: Tensor) -> Tensor:
        """[N, M] of each match: that both features have a counterpart, times the softmax of their
        similarities over the rows and over the columns."""
        similar_a, similar_b = (self._linear(f"{name}.final_proj", x) for x in (a, b))
        similarity = similar_a @ similar_b.T / a.shape[1] ** 0.5
        seen_a, seen_b = (
            functional.logsigmoid(self._linear(f"{name}.matchability", x)) for x in (a, b)
        )
        both: Tensor = similarity.log_softmax(1) + similarity.log_softmax(0)
        return both + seen_a + seen_b.T


def _attention(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    # The fast kernel wants dimensions for batches and heads.
    query, key, value = query[None, None], key[None, None], value[None, None]
    message: Tensor = functional.scaled_dot_product_attention(query, key, value)[0, 0]
    return message


def _rotated(x: Tensor, turn: tuple[Tensor, Tensor]) -> Tensor:
    """x [N, C] with each pair of channels turned by an angle."""
    even, odd = x[:, ::2], x[:, 1::2]
    return x * turn[0] + torch.stack((-odd, even), 2).flatten(1) * turn[1]
