"""The command line: thin commands, and how they show progress, signals and results."""
