-- Work on datasets that lasts longer than a request: their commits, and files that are fetched from an address.
-- A row outlives the front end that took it, and is asked for its state.

CREATE TABLE dataset_tasks (
    id uuid PRIMARY KEY,
    dataset_id uuid NOT NULL REFERENCES datasets ON DELETE CASCADE,
    owner text NOT NULL,
    kind text NOT NULL,
    state text NOT NULL DEFAULT 'queued' CHECK (state IN ('queued', 'running', 'succeeded', 'failed')),
    request jsonb NOT NULL DEFAULT '{}',
    attempt integer NOT NULL DEFAULT 0,
    result jsonb,
    problem jsonb,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    started_at timestamptz,
    seen_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    finished_at timestamptz
);
CREATE INDEX dataset_tasks_dataset ON dataset_tasks (dataset_id, id DESC);
CREATE INDEX dataset_tasks_unfinished ON dataset_tasks (owner, id) WHERE state IN ('queued', 'running');
CREATE INDEX dataset_tasks_turns ON dataset_tasks (owner, started_at);
CREATE UNIQUE INDEX dataset_tasks_one_commit ON dataset_tasks (dataset_id)
    WHERE kind = 'commit' AND state IN ('queued', 'running');
