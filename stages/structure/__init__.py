"""Structure from motion: features, matches, mapping, and the gates it must pass."""
