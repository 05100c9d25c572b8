"""One scene in blocks: where it is cut, who sees which block, and how blocks become one again."""
