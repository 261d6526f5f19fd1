"""The job service's tables and its queue, both in one Postgres.

``jobs`` says what is true; a slip in the queue only says that somebody should look at a job. Both are written
in one transaction.
"""
