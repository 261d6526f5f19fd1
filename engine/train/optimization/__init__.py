"""Losses, the optimizer and the mean of its last states."""
