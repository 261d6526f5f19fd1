"""Tables of the job service and its queue, both in one Postgres.

``jobs`` has the state; an entry in the queue only says that a worker should look at a job. Both are written
in one transaction.
"""
