"""Paths through a scene, and the pictures and films drawn along them."""
