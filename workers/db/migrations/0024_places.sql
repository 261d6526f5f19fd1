-- The blocks of a job stand in the queue where the job did, and so do not lose their turn by being planned.

-- The entry with which it was queued, which it keeps when it is interrupted or passed over; of a block that of the
-- whole. NULL where the last version queued it: then its entry counts.
ALTER TABLE jobs ADD COLUMN place bigint;

CREATE INDEX jobs_next ON jobs (queue, owner, priority DESC, (coalesce(place, slip)), slip) INCLUDE (place)
    WHERE state = 'queued';
DROP INDEX jobs_waiting;

-- Whether a block of a job has ended without success is asked after each of them.
CREATE INDEX jobs_root_ended ON jobs (root_id) WHERE root_id IS NOT NULL AND state IN ('failed', 'canceled');
