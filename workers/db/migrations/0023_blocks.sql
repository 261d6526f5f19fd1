-- Jobs in blocks: one job is seen, the root, and others do its parts. A root that waits for them is in the state running
-- without a heartbeat, by which no version takes it for lost.

ALTER TABLE jobs ADD COLUMN root_id uuid REFERENCES jobs ON DELETE CASCADE,
    ADD COLUMN role text CHECK (role IN ('root', 'block'));
CREATE INDEX jobs_root ON jobs (root_id) WHERE root_id IS NOT NULL;

-- What has to succeed before a job is queued again.
CREATE TABLE job_needs (
    job_id uuid NOT NULL REFERENCES jobs ON DELETE CASCADE,
    needs_id uuid NOT NULL REFERENCES jobs ON DELETE CASCADE,
    PRIMARY KEY (job_id, needs_id)
);
CREATE INDEX job_needs_needed ON job_needs (needs_id);

-- As before, but for the parts of a job, of which nobody is told.
CREATE OR REPLACE FUNCTION octasplat_tell_webhooks() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO webhook_deliveries (endpoint_id, kind, payload)
    SELECT endpoints.id, 'job.' || (NEW.data->>'state'), jsonb_build_object(
        'type', 'job.' || (NEW.data->>'state'),
        'timestamp', to_char(NEW.at AT TIME ZONE 'UTC', 'YYYY-MM-DD"T"HH24:MI:SS.US"Z"'),
        'data', jsonb_build_object('job_id', jobs.id, 'kind', jobs.kind, 'label', jobs.label,
            'state', NEW.data->>'state', 'attempt', NEW.attempt))
    FROM jobs JOIN webhook_endpoints endpoints
        ON endpoints.owner = jobs.owner AND (endpoints.job_id IS NULL OR endpoints.job_id = jobs.id)
    WHERE jobs.id = NEW.job_id AND jobs.root_id IS NULL AND endpoints.enabled
        AND 'job.' || (NEW.data->>'state') = ANY(endpoints.events)
    FOR KEY SHARE OF endpoints;
    RETURN NULL;
END;
$$;
