-- What an administrator holds back: queues that hand out no jobs, and workers that take no new ones.

CREATE TABLE paused_queues (
    queue text PRIMARY KEY,
    since timestamptz NOT NULL DEFAULT now()
);

CREATE TABLE drained_workers (
    name text PRIMARY KEY,
    since timestamptz NOT NULL DEFAULT now()
);
