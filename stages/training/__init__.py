"""Training: the loop, its steps, loss, optimiser, densification and schedule, and fine-tuning."""
