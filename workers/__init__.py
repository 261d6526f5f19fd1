"""Runs the engine: the command line, and the queue of jobs with all that takes and keeps them."""
