-- Owners share the workers whatever the priorities of their jobs; an administrator may give an owner more.

ALTER TABLE quotas ADD COLUMN share real CHECK (share > 0);

-- Until when a queued job is left in the queue, as its entry says too; NULL if it may begin now.
ALTER TABLE jobs ADD COLUMN delayed_until timestamptz;

-- The owners that wait are found by one look each, and each one's next job by another.
CREATE INDEX jobs_waiting ON jobs (queue, owner, priority DESC, slip) WHERE state = 'queued';
