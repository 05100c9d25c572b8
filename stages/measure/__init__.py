"""Evaluation of pictures, the contribution of each splat, capture coverage, trade-off reports."""
