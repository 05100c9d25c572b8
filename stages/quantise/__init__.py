"""Stage 6: at which precision splats are stored, and fine-tuning to the rounding of formats."""
