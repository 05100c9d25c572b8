"""What compiled kernels stand on: vectors, threads, and where they are kept."""
