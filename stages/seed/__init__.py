"""Stage 3: `Reconstruction` -> the first `Splats`: at sparse points, and where there are none."""
