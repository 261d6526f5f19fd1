"""Runs the engine: the command line, and later the processes that take jobs from the queue."""
