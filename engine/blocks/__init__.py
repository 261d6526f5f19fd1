"""Trainings in blocks: a coarse scene, its partition, a training for each block, and their merge."""
