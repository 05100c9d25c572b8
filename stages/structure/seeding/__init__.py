"""Initial splats besides those at the sparse points."""
