"""Runs, blocks of a scene and chunks of structure from motion, here or on a Ray cluster."""
