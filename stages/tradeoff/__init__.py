"""The trade-off report of one run, and the comparison of two."""
