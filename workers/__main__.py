"""``python -m workers`` is the command line, for processes that start others of their kind."""

from workers.cli.main import main

main()
