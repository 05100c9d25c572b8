"""The worker process, which alone imports COLMAP: features, pairs, matches, mapping."""
