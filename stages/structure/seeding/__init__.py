"""Where splats may start besides at the sparse points."""
