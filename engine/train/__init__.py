"""Training: initialisation, batches, losses, the optimiser, densification, checkpoints and the loop."""
