"""Stage 5: removes splats and SH coefficients that the photographs do not need."""
