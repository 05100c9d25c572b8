"""Image retrieval: pairs of photographs with similar bags of visual words (TF-IDF).

Cheap enough to compare every pair of many photographs; only the best pairs are then compared by
their largest features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from stages.base.row_slices import row_slices

CANDIDATES = 48  # for each photograph
NEIGHBOURS = 4  # in the capture's order, on either side
_BLOCK = 64  # photographs compared with all others between two progress reports


def candidate_pairs(
    words_of: Sequence[NDArray[np.int64]], tick: Callable[[int], None] = lambda done: None
) -> list[tuple[int, int]]:
    """Pairs (first, second): the most similar photographs of each, and neighbours.

    Photographs are similar if they share many rare words (Sivic and Zisserman 2003).

    Args:
        words_of: the words of each photograph's features.
        tick: called with the number of photographs that are compared with all others.
    """
    photographs = len(words_of)
    similarity = _cosines(words_of, tick)
    index = np.arange(photographs)
    pairs = set()
    for i, row in enumerate(similarity):
        row[i] = -1.0
        best = np.lexsort((np.abs(index - i), -row))[:CANDIDATES].tolist()
        near = range(max(0, i - NEIGHBOURS), min(photographs, i + NEIGHBOURS + 1))
        pairs |= {(min(i, j), max(i, j)) for j in (*best, *near) if j != i}
    return sorted(pairs)


def _cosines(
    words_of: Sequence[NDArray[np.int64]], tick: Callable[[int], None]
) -> NDArray[np.float64]:
    """[P, P] cosines between TF-IDF vectors, rounded so that they are the same on every machine."""
    photographs = len(words_of)
    rows = np.repeat(np.arange(photographs), [len(words) for words in words_of])
    words, columns = np.unique(np.concatenate(words_of), return_inverse=True)
    table = sparse.csr_matrix(
        (np.ones(len(rows)), (rows, columns)), shape=(photographs, max(1, len(words)))
    )
    table.data = np.sqrt(table.data)
    documents = np.bincount(table.indices, minlength=table.shape[1])
    table.data *= np.log(photographs / np.maximum(documents, 1))[table.indices]
    lengths = np.sqrt(np.asarray(table.multiply(table).sum(axis=1)).ravel())
    scaled = (sparse.diags(1.0 / np.maximum(lengths, 1e-12)) @ table).tocsr()
    others = scaled.T.tocsr()
    cosines = np.empty((photographs, photographs))
    for part in row_slices(photographs, _BLOCK):
        cosines[part] = np.round((scaled[part] @ others).toarray(), 9)
        tick(part.stop)
    return cosines
