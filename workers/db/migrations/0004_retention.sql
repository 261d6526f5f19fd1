-- What retention needs to know, and counters that outlive the rows they count.

CREATE INDEX jobs_expiring ON jobs (expires_at) WHERE expires_at IS NOT NULL;
CREATE INDEX datasets_expiring ON datasets (expires_at) WHERE expires_at IS NOT NULL;

-- Contents of checkpoints and previews that newer ones have replaced; unless something else names them they can
-- go long before an abandoned upload can.
CREATE TABLE replaced_contents (
    sha256 text PRIMARY KEY,
    replaced_at timestamptz NOT NULL DEFAULT now()
);

CREATE FUNCTION octasplat_remember_replaced() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO replaced_contents (sha256)
    SELECT DISTINCT old_file->>'sha256' FROM jsonb_array_elements(
        coalesce(OLD.checkpoint->'files', '[]'::jsonb)
        || CASE WHEN OLD.preview ? 'sha256' THEN jsonb_build_array(OLD.preview) ELSE '[]'::jsonb END
    ) AS old_file
    WHERE NOT EXISTS (
        SELECT 1 FROM jsonb_array_elements(
            coalesce(NEW.checkpoint->'files', '[]'::jsonb)
            || CASE WHEN NEW.preview ? 'sha256' THEN jsonb_build_array(NEW.preview) ELSE '[]'::jsonb END
        ) AS new_file WHERE new_file->>'sha256' = old_file->>'sha256'
    )
    ORDER BY 1
    ON CONFLICT (sha256) DO UPDATE SET replaced_at = now();
    RETURN NULL;
END;
$$;
CREATE TRIGGER jobs_replaced AFTER UPDATE OF checkpoint, preview ON jobs FOR EACH ROW
    WHEN (OLD.checkpoint IS DISTINCT FROM NEW.checkpoint OR OLD.preview IS DISTINCT FROM NEW.preview)
    EXECUTE FUNCTION octasplat_remember_replaced();

-- Sequences: they only rise, whatever is deleted, and nobody waits for them. A transaction that is rolled back
-- may have been counted.
CREATE SEQUENCE octasplat_total_attempts;
CREATE SEQUENCE octasplat_total_rescues;
CREATE SEQUENCE octasplat_total_poisoned;
CREATE SEQUENCE octasplat_total_succeeded;
CREATE SEQUENCE octasplat_total_failed;
CREATE SEQUENCE octasplat_total_canceled;

CREATE FUNCTION octasplat_count_event() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF NEW.kind = 'rescued' THEN
        PERFORM nextval('octasplat_total_rescues');
    ELSIF NEW.data->>'state' = 'running' THEN
        PERFORM nextval('octasplat_total_attempts');
    ELSIF NEW.data->>'state' IN ('succeeded', 'failed', 'canceled') THEN
        PERFORM nextval(('octasplat_total_' || (NEW.data->>'state'))::regclass);
        IF NEW.data->'error' ? 'rescues' THEN
            PERFORM nextval('octasplat_total_poisoned');
        END IF;
    END IF;
    RETURN NULL;
END;
$$;
CREATE TRIGGER job_events_counted AFTER INSERT ON job_events FOR EACH ROW
    WHEN (NEW.kind IN ('state', 'rescued')) EXECUTE FUNCTION octasplat_count_event();

-- A store belongs to one database: whoever collects its unused contents has to be sure of that.
CREATE TABLE installation (
    id uuid PRIMARY KEY DEFAULT gen_random_uuid(),
    collected_at timestamptz NOT NULL DEFAULT '-infinity'
);
INSERT INTO installation DEFAULT VALUES;
