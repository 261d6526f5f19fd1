-- Datasets, jobs and what belongs to them.

CREATE TABLE datasets (
    id uuid PRIMARY KEY,
    owner text NOT NULL,
    name text NOT NULL,
    state text NOT NULL DEFAULT 'open' CHECK (state IN ('open', 'checking', 'committed')),
    has_poses boolean NOT NULL DEFAULT false,
    photographs integer NOT NULL DEFAULT 0,
    facts jsonb NOT NULL DEFAULT '{}',
    pinned boolean NOT NULL DEFAULT false,
    created_at timestamptz NOT NULL DEFAULT now(),
    committed_at timestamptz,
    used_at timestamptz NOT NULL DEFAULT now(),
    expires_at timestamptz,
    version bigint NOT NULL DEFAULT 1
);
CREATE INDEX datasets_owner ON datasets (owner, id DESC);

CREATE TABLE dataset_files (
    dataset_id uuid NOT NULL REFERENCES datasets ON DELETE CASCADE,
    path text NOT NULL,
    sha256 text NOT NULL,
    size_bytes bigint NOT NULL,
    facts jsonb NOT NULL DEFAULT '{}',
    uploaded_at timestamptz NOT NULL DEFAULT now(),
    PRIMARY KEY (dataset_id, path)
);
CREATE INDEX dataset_files_sha256 ON dataset_files (sha256);

CREATE TABLE jobs (
    id uuid PRIMARY KEY,
    owner text NOT NULL,
    kind text NOT NULL,
    dataset_id uuid REFERENCES datasets ON DELETE RESTRICT,
    source_id uuid REFERENCES jobs ON DELETE RESTRICT,
    label text,
    options jsonb NOT NULL,
    queue text NOT NULL,
    priority integer NOT NULL DEFAULT 0,
    slip bigint,
    state text NOT NULL DEFAULT 'queued'
        CHECK (state IN ('queued', 'running', 'canceling', 'succeeded', 'failed', 'canceled')),
    attempt integer NOT NULL DEFAULT 0,
    fresh_after integer NOT NULL DEFAULT 0,
    rescues integer NOT NULL DEFAULT 0,
    stage text,
    step integer,
    total_steps integer,
    seconds_left double precision,
    psnr double precision,
    worker text,
    error jsonb,
    checkpoint jsonb,
    preview jsonb,
    traceparent text,
    pinned boolean NOT NULL DEFAULT false,
    created_at timestamptz NOT NULL DEFAULT now(),
    queued_at timestamptz NOT NULL DEFAULT now(),
    started_at timestamptz,
    heartbeat_at timestamptz,
    finished_at timestamptz,
    expires_at timestamptz,
    version bigint NOT NULL DEFAULT 1
);
CREATE INDEX jobs_owner ON jobs (owner, id DESC);
CREATE INDEX jobs_dataset ON jobs (dataset_id);
CREATE INDEX jobs_source ON jobs (source_id);
CREATE INDEX jobs_unfinished ON jobs (state, queue, priority DESC, queued_at)
    WHERE state IN ('queued', 'running', 'canceling');

CREATE TABLE artifacts (
    job_id uuid NOT NULL REFERENCES jobs ON DELETE CASCADE,
    name text NOT NULL,
    sha256 text NOT NULL,
    size_bytes bigint NOT NULL,
    media_type text NOT NULL,
    PRIMARY KEY (job_id, name)
);
CREATE INDEX artifacts_sha256 ON artifacts (sha256);

CREATE TABLE job_events (
    id bigint PRIMARY KEY GENERATED ALWAYS AS IDENTITY,
    job_id uuid NOT NULL REFERENCES jobs ON DELETE CASCADE,
    attempt integer NOT NULL,
    kind text NOT NULL,
    data jsonb NOT NULL,
    at timestamptz NOT NULL DEFAULT clock_timestamp()
);
CREATE INDEX job_events_job ON job_events (job_id, id);

CREATE TABLE job_logs (
    id bigint PRIMARY KEY GENERATED ALWAYS AS IDENTITY,
    job_id uuid NOT NULL REFERENCES jobs ON DELETE CASCADE,
    attempt integer NOT NULL,
    text text NOT NULL,
    at timestamptz NOT NULL DEFAULT clock_timestamp()
);
CREATE INDEX job_logs_job ON job_logs (job_id, id);

CREATE TABLE workers (
    id uuid PRIMARY KEY,
    name text NOT NULL,
    queues text[] NOT NULL,
    slots integer NOT NULL,
    facts jsonb NOT NULL DEFAULT '{}',
    started_at timestamptz NOT NULL DEFAULT now(),
    seen_at timestamptz NOT NULL DEFAULT now()
);

CREATE TABLE tokens (
    id uuid PRIMARY KEY,
    owner text NOT NULL,
    name text NOT NULL,
    sha256 text NOT NULL UNIQUE,
    scopes text[] NOT NULL,
    created_at timestamptz NOT NULL DEFAULT now(),
    expires_at timestamptz,
    revoked_at timestamptz
);

CREATE TABLE idempotency_keys (
    owner text NOT NULL,
    key text NOT NULL,
    fingerprint text NOT NULL,
    resource_id uuid NOT NULL,
    created_at timestamptz NOT NULL DEFAULT now(),
    PRIMARY KEY (owner, key)
);

-- The number in a row's ETag.
CREATE FUNCTION octasplat_count_version() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    NEW.version := OLD.version + 1;
    RETURN NEW;
END;
$$;
CREATE FUNCTION octasplat_count_job_version() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    -- A heartbeat alone is no change that anybody waits for.
    OLD.heartbeat_at := NEW.heartbeat_at;
    IF OLD IS DISTINCT FROM NEW THEN
        NEW.version := OLD.version + 1;
    END IF;
    RETURN NEW;
END;
$$;
CREATE TRIGGER jobs_version BEFORE UPDATE ON jobs FOR EACH ROW EXECUTE FUNCTION octasplat_count_job_version();
CREATE TRIGGER datasets_version BEFORE UPDATE ON datasets FOR EACH ROW EXECUTE FUNCTION octasplat_count_version();

-- Whoever streams a job's events hears of new ones.
CREATE FUNCTION octasplat_tell_of_event() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    PERFORM pg_notify('octasplat_events', NEW.job_id::text);
    RETURN NULL;
END;
$$;
CREATE TRIGGER job_events_told AFTER INSERT ON job_events FOR EACH ROW EXECUTE FUNCTION octasplat_tell_of_event();
