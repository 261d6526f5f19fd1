-- Short locks: contents are counted a statement at a time, removed without a lock, and webhooks may go meanwhile.
-- The order of locks is written down in workers/records/locks.py.

-- Contents that are being removed from the store at this moment.
CREATE TABLE removing_contents (
    sha256 text PRIMARY KEY,
    since timestamptz NOT NULL DEFAULT clock_timestamp()
);

-- What a statement adds to or takes from an owner's contents, all of it under one lock and in one step.
CREATE FUNCTION octasplat_count_contents(whose text, contents text[], lengths bigint[], changes integer[])
RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    -- The lock of an owner, see workers/records/locks.py.
    PERFORM pg_advisory_xact_lock(1903521652, hashtext(whose));
    WITH changed AS (
        SELECT given.sha256, max(given.length) AS length, sum(given.by) AS by
        FROM unnest(contents, lengths, changes) AS given (sha256, length, by)
        GROUP BY given.sha256 HAVING sum(given.by) <> 0
    ), counted AS (
        INSERT INTO owner_contents AS known (owner, sha256, size_bytes, places)
        SELECT whose, sha256, length, by FROM changed
        ON CONFLICT (owner, sha256) DO UPDATE SET places = known.places + excluded.places
        RETURNING known.sha256, known.size_bytes, known.places
    ), deltas AS (
        SELECT hashtext(sha256) & 15 AS part, sum(CASE
            WHEN places > 0 AND places - by <= 0 THEN size_bytes
            WHEN places <= 0 AND places - by > 0 THEN -size_bytes
            ELSE 0 END) AS bytes
        FROM counted JOIN changed USING (sha256) GROUP BY 1
    )
    INSERT INTO owner_usage AS known (owner, part, bytes)
    SELECT whose, part, bytes FROM deltas WHERE bytes <> 0
    ON CONFLICT (owner, part) DO UPDATE SET bytes = known.bytes + excluded.bytes;
    DELETE FROM owner_contents WHERE owner = whose AND sha256 = ANY(contents) AND places <= 0;
END;
$$;

CREATE FUNCTION octasplat_count_dataset_files() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP <> 'INSERT' THEN
        PERFORM octasplat_count_contents(d.owner, array_agg(f.sha256), array_agg(f.size_bytes), array_agg(-1))
        FROM removed f JOIN datasets d ON d.id = f.dataset_id GROUP BY d.owner;
    END IF;
    IF TG_OP <> 'DELETE' THEN
        PERFORM octasplat_count_contents(d.owner, array_agg(f.sha256), array_agg(f.size_bytes), array_agg(1))
        FROM added f JOIN datasets d ON d.id = f.dataset_id GROUP BY d.owner;
    END IF;
    RETURN NULL;
END;
$$;
CREATE FUNCTION octasplat_count_artifacts() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP <> 'INSERT' THEN
        PERFORM octasplat_count_contents(j.owner, array_agg(a.sha256), array_agg(a.size_bytes), array_agg(-1))
        FROM removed a JOIN jobs j ON j.id = a.job_id GROUP BY j.owner;
    END IF;
    IF TG_OP <> 'DELETE' THEN
        PERFORM octasplat_count_contents(j.owner, array_agg(a.sha256), array_agg(a.size_bytes), array_agg(1))
        FROM added a JOIN jobs j ON j.id = a.job_id GROUP BY j.owner;
    END IF;
    RETURN NULL;
END;
$$;

DROP TRIGGER dataset_files_counted ON dataset_files;
DROP TRIGGER artifacts_counted ON artifacts;
DROP FUNCTION octasplat_count_files();
CREATE TRIGGER dataset_files_added AFTER INSERT ON dataset_files
    REFERENCING NEW TABLE AS added FOR EACH STATEMENT EXECUTE FUNCTION octasplat_count_dataset_files();
CREATE TRIGGER dataset_files_changed AFTER UPDATE ON dataset_files
    REFERENCING OLD TABLE AS removed NEW TABLE AS added
    FOR EACH STATEMENT EXECUTE FUNCTION octasplat_count_dataset_files();
CREATE TRIGGER dataset_files_removed AFTER DELETE ON dataset_files
    REFERENCING OLD TABLE AS removed FOR EACH STATEMENT EXECUTE FUNCTION octasplat_count_dataset_files();
CREATE TRIGGER artifacts_added AFTER INSERT ON artifacts
    REFERENCING NEW TABLE AS added FOR EACH STATEMENT EXECUTE FUNCTION octasplat_count_artifacts();
CREATE TRIGGER artifacts_changed AFTER UPDATE ON artifacts
    REFERENCING OLD TABLE AS removed NEW TABLE AS added
    FOR EACH STATEMENT EXECUTE FUNCTION octasplat_count_artifacts();
CREATE TRIGGER artifacts_removed AFTER DELETE ON artifacts
    REFERENCING OLD TABLE AS removed FOR EACH STATEMENT EXECUTE FUNCTION octasplat_count_artifacts();

CREATE OR REPLACE FUNCTION octasplat_count_checkpoint() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    before jsonb := coalesce(OLD.checkpoint->'files', '[]'::jsonb);
    after jsonb := '[]'::jsonb;
BEGIN
    IF TG_OP = 'UPDATE' THEN
        after := coalesce(NEW.checkpoint->'files', '[]'::jsonb);
    END IF;
    -- Content that occurs twice in a checkpoint has one place there.
    PERFORM octasplat_count_contents(
        OLD.owner, array_agg(sha256), array_agg(size_bytes), array_agg(is_new - was_there)
    ) FROM (
        SELECT sha256, max(size_bytes) AS size_bytes, max(is_new) AS is_new, max(was_there) AS was_there FROM (
            SELECT file->>'sha256' AS sha256, (file->>'size_bytes')::bigint AS size_bytes, 1 AS is_new, 0 AS was_there
            FROM jsonb_array_elements(after) AS file
            UNION ALL
            SELECT file->>'sha256', (file->>'size_bytes')::bigint, 0, 1 FROM jsonb_array_elements(before) AS file
        ) AS files GROUP BY sha256
    ) AS changed HAVING count(*) > 0;
    RETURN NULL;
END;
$$;
DROP FUNCTION octasplat_count_content(text, text, bigint, integer);

-- Counts all owners' contents anew; says whose count was another. Nobody writes meanwhile.
CREATE FUNCTION octasplat_recount() RETURNS TABLE (whose text, bytes_before bigint, bytes_after bigint)
LANGUAGE plpgsql AS $$
BEGIN
    LOCK TABLE jobs, datasets, dataset_files, artifacts, owner_contents, owner_usage IN SHARE ROW EXCLUSIVE MODE;
    CREATE TEMPORARY TABLE usage_before ON COMMIT DROP AS
        SELECT u.owner, sum(u.bytes)::bigint AS bytes FROM owner_usage u GROUP BY u.owner;
    DELETE FROM owner_contents;
    DELETE FROM owner_usage;
    INSERT INTO owner_contents (owner, sha256, size_bytes, places)
    SELECT c.owner, c.sha256, max(c.size_bytes), count(*) FROM (
        SELECT d.owner, f.sha256, f.size_bytes FROM dataset_files f JOIN datasets d ON d.id = f.dataset_id
        UNION ALL
        SELECT j.owner, a.sha256, a.size_bytes FROM artifacts a JOIN jobs j ON j.id = a.job_id
        UNION ALL
        SELECT j.owner, k.sha256, k.size_bytes FROM jobs j CROSS JOIN LATERAL (
            SELECT file->>'sha256' AS sha256, max((file->>'size_bytes')::bigint) AS size_bytes
            FROM jsonb_array_elements(coalesce(j.checkpoint->'files', '[]'::jsonb)) AS file GROUP BY 1
        ) k
    ) AS c GROUP BY c.owner, c.sha256;
    INSERT INTO owner_usage (owner, part, bytes)
    SELECT c.owner, hashtext(c.sha256) & 15, sum(c.size_bytes) FROM owner_contents c GROUP BY 1, 2;
    RETURN QUERY
        SELECT coalesce(b.owner, a.owner), coalesce(b.bytes, 0), coalesce(a.bytes, 0)
        FROM usage_before b FULL JOIN (
            SELECT u.owner, sum(u.bytes)::bigint AS bytes FROM owner_usage u GROUP BY u.owner
        ) a ON a.owner = b.owner
        WHERE coalesce(b.bytes, 0) <> coalesce(a.bytes, 0) ORDER BY 1;
    DROP TABLE usage_before;
END;
$$;
-- Step 0008 counted beside running uploads and may have missed some.
SELECT octasplat_recount();

-- A webhook that is being deleted is not told: its row is waited for, and gone by then.
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
    WHERE jobs.id = NEW.job_id AND endpoints.enabled
        AND 'job.' || (NEW.data->>'state') = ANY(endpoints.events)
    FOR KEY SHARE OF endpoints;
    RETURN NULL;
END;
$$;
