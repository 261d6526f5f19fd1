-- Who is told of what happens to jobs, and what they were or have to be told.

CREATE TABLE webhook_endpoints (
    id uuid PRIMARY KEY,
    owner text NOT NULL,
    job_id uuid REFERENCES jobs ON DELETE CASCADE,
    url text NOT NULL,
    secret text NOT NULL,
    events text[] NOT NULL,
    enabled boolean NOT NULL DEFAULT true,
    disabled_reason text,
    created_at timestamptz NOT NULL DEFAULT now()
);
CREATE INDEX webhook_endpoints_owner ON webhook_endpoints (owner, id DESC);
CREATE INDEX webhook_endpoints_job ON webhook_endpoints (job_id);

CREATE TABLE webhook_deliveries (
    id uuid PRIMARY KEY DEFAULT gen_random_uuid(),
    endpoint_id uuid NOT NULL REFERENCES webhook_endpoints ON DELETE CASCADE,
    kind text NOT NULL,
    payload jsonb NOT NULL,
    state text NOT NULL DEFAULT 'pending' CHECK (state IN ('pending', 'delivered', 'failed')),
    tries integer NOT NULL DEFAULT 0,
    failures integer NOT NULL DEFAULT 0,
    due_at timestamptz NOT NULL DEFAULT now(),
    status integer,
    error text,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    tried_at timestamptz
);
CREATE INDEX webhook_deliveries_due ON webhook_deliveries (due_at) WHERE state = 'pending';
CREATE INDEX webhook_deliveries_endpoint ON webhook_deliveries (endpoint_id, created_at DESC);

-- In the transaction in which a job changes its state, so that nobody is told of what did not happen and
-- nothing that happened goes untold.
CREATE FUNCTION octasplat_tell_webhooks() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO webhook_deliveries (endpoint_id, kind, payload)
    SELECT endpoints.id, 'job.' || (NEW.data->>'state'), jsonb_build_object(
        'type', 'job.' || (NEW.data->>'state'),
        'timestamp', to_char(NEW.at AT TIME ZONE 'UTC', 'YYYY-MM-DD"T"HH24:MI:SS.US"Z"'),
        'data', jsonb_build_object('job_id', jobs.id, 'kind', jobs.kind, 'label', jobs.label,
            'state', NEW.data->>'state', 'attempt', NEW.attempt))
    FROM jobs JOIN webhook_endpoints endpoints
        ON endpoints.owner = jobs.owner AND (endpoints.job_id IS NULL OR endpoints.job_id = jobs.id)
    WHERE jobs.id = NEW.job_id AND endpoints.enabled
        AND 'job.' || (NEW.data->>'state') = ANY(endpoints.events);
    RETURN NULL;
END;
$$;
CREATE TRIGGER job_events_webhooks AFTER INSERT ON job_events FOR EACH ROW
    WHEN (NEW.kind = 'state') EXECUTE FUNCTION octasplat_tell_webhooks();
