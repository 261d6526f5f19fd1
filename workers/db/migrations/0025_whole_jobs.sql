-- A job in blocks is one start, however many attempts of its own there are, and its time is that of the whole.

-- Attempts that went on with what blocks had made: the same start for its owner.
ALTER TABLE jobs ADD COLUMN continuations integer[] NOT NULL DEFAULT '{}',
    -- When the attempt began that planned the blocks; NULL for any other job.
    ADD COLUMN begun_at timestamptz;

-- As before, but an attempt that goes on with what blocks have made is no further one.
CREATE OR REPLACE FUNCTION octasplat_tell_webhooks() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO webhook_deliveries (endpoint_id, kind, payload)
    SELECT endpoints.id, 'job.' || (NEW.data->>'state'), jsonb_build_object(
        'type', 'job.' || (NEW.data->>'state'),
        'timestamp', to_char(NEW.at AT TIME ZONE 'UTC', 'YYYY-MM-DD"T"HH24:MI:SS.US"Z"'),
        'data', jsonb_build_object('job_id', jobs.id, 'kind', jobs.kind, 'label', jobs.label,
            'state', NEW.data->>'state', 'attempt', NEW.attempt - (
                SELECT count(*) FROM unnest(jobs.continuations) AS continued WHERE continued <= NEW.attempt)))
    FROM jobs JOIN webhook_endpoints endpoints
        ON endpoints.owner = jobs.owner AND (endpoints.job_id IS NULL OR endpoints.job_id = jobs.id)
    WHERE jobs.id = NEW.job_id AND jobs.root_id IS NULL AND endpoints.enabled
        AND 'job.' || (NEW.data->>'state') = ANY(endpoints.events)
    FOR KEY SHARE OF endpoints;
    RETURN NULL;
END;
$$;
