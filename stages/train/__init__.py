"""Stage 4: `Splats` -> `TrainedSplats`: the loop, its steps, loss, optimiser and densification."""
