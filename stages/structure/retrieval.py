"""Which photographs may show the same thing, from the words that both hold.

Costs next to nothing a pair, so that a first look need not be at every two of many photographs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from stages.base.blocks import blocks

CANDIDATES = 48  # of each photograph; up to so many others, all are
NEIGHBOURS = 4  # in order of the capture, either way
_AT_ONCE = 64  # photographs compared with all others between two ticks


def candidate_pairs(
    held: Sequence[NDArray[np.int64]], tick: Callable[[int], None] = lambda done: None
) -> list[tuple[int, int]]:
    """Pairs (first, second) to look at: the most alike of each photograph, and neighbours.

    held: the words of each photograph's features. Alike are those that share many rare words
    (Sivic and Zisserman 2003). tick: told how many photographs are compared with all others.
    """
    photographs = len(held)
    alike = _likeness(held, tick)
    index = np.arange(photographs)
    pairs = set()
    for i, row in enumerate(alike):
        row[i] = -1.0
        best = np.lexsort((np.abs(index - i), -row))[:CANDIDATES].tolist()
        near = range(max(0, i - NEIGHBOURS), min(photographs, i + NEIGHBOURS + 1))
        pairs |= {(min(i, j), max(i, j)) for j in (*best, *near) if j != i}
    return sorted(pairs)


def _likeness(
    held: Sequence[NDArray[np.int64]], tick: Callable[[int], None]
) -> NDArray[np.float64]:
    """[P, P] cosines between photographs as vectors of words; the rarer a word, the more it
    counts. Rounded, so that no machine's last digit decides."""
    photographs = len(held)
    rows = np.repeat(np.arange(photographs), [len(words) for words in held])
    words, columns = np.unique(np.concatenate(held), return_inverse=True)
    table = sparse.csr_matrix(
        (np.ones(len(rows)), (rows, columns)), shape=(photographs, max(1, len(words)))
    )
    table.data = np.sqrt(table.data)
    holders = np.bincount(table.indices, minlength=table.shape[1])
    table.data *= np.log(photographs / np.maximum(holders, 1))[table.indices]
    lengths = np.sqrt(np.asarray(table.multiply(table).sum(axis=1)).ravel())
    scaled = (sparse.diags(1.0 / np.maximum(lengths, 1e-12)) @ table).tocsr()
    others = scaled.T.tocsr()
    likeness = np.empty((photographs, photographs))
    for part in blocks(photographs, _AT_ONCE):
        likeness[part] = np.round((scaled[part] @ others).toarray(), 9)
        tick(part.stop)
    return likeness
