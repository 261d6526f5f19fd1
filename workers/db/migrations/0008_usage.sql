-- What an owner's things take in the store, kept as it changes: files of datasets, results, and checkpoints of jobs
-- that have not succeeded. Content that occurs twice counts once.

CREATE TABLE owner_contents (
    owner text NOT NULL,
    sha256 text NOT NULL,
    size_bytes bigint NOT NULL,
    places bigint NOT NULL,
    PRIMARY KEY (owner, sha256)
);
-- In sixteen parts, as a row that one transaction changes thousands of times becomes slow.
CREATE TABLE owner_usage (
    owner text NOT NULL,
    part integer NOT NULL,
    bytes bigint NOT NULL,
    PRIMARY KEY (owner, part)
);

-- Nobody writes while it is counted, or what they write would be missed for ever.
LOCK TABLE jobs, datasets, dataset_files, artifacts IN SHARE ROW EXCLUSIVE MODE;
INSERT INTO owner_contents (owner, sha256, size_bytes, places)
SELECT owner, sha256, max(size_bytes), count(*) FROM (
    SELECT d.owner, f.sha256, f.size_bytes FROM dataset_files f JOIN datasets d ON d.id = f.dataset_id
    UNION ALL
    SELECT j.owner, a.sha256, a.size_bytes FROM artifacts a JOIN jobs j ON j.id = a.job_id
    UNION ALL
    SELECT j.owner, c.sha256, c.size_bytes FROM jobs j CROSS JOIN LATERAL (
        SELECT file->>'sha256' AS sha256, max((file->>'size_bytes')::bigint) AS size_bytes
        FROM jsonb_array_elements(coalesce(j.checkpoint->'files', '[]'::jsonb)) AS file GROUP BY 1
    ) c
) AS contents GROUP BY owner, sha256;
INSERT INTO owner_usage (owner, part, bytes)
SELECT owner, hashtext(sha256) & 15, sum(size_bytes) FROM owner_contents GROUP BY 1, 2;

CREATE FUNCTION octasplat_count_content(whose text, content text, length bigint, by integer) RETURNS void
LANGUAGE plpgsql AS $$
DECLARE
    left_places bigint;
    counted bigint;
BEGIN
    -- The lock under which quotas are checked, see workers/records/quotas.py.
    PERFORM pg_advisory_xact_lock(1903521652, hashtext(whose));
    INSERT INTO owner_contents AS known (owner, sha256, size_bytes, places) VALUES (whose, content, length, by)
    ON CONFLICT (owner, sha256) DO UPDATE SET places = known.places + by
    RETURNING places, size_bytes INTO left_places, counted;
    IF left_places <= 0 THEN
        DELETE FROM owner_contents WHERE owner = whose AND sha256 = content;
        UPDATE owner_usage SET bytes = bytes - counted WHERE owner = whose AND part = hashtext(content) & 15;
    ELSIF by > 0 AND left_places = by THEN
        INSERT INTO owner_usage AS known (owner, part, bytes) VALUES (whose, hashtext(content) & 15, counted)
        ON CONFLICT (owner, part) DO UPDATE SET bytes = known.bytes + excluded.bytes;
    END IF;
END;
$$;

CREATE FUNCTION octasplat_count_files() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    whose text;
BEGIN
    IF TG_TABLE_NAME = 'artifacts' THEN
        SELECT owner INTO whose FROM jobs WHERE id = (CASE WHEN TG_OP = 'DELETE' THEN OLD ELSE NEW END).job_id;
    ELSE
        SELECT owner INTO whose FROM datasets
        WHERE id = (CASE WHEN TG_OP = 'DELETE' THEN OLD ELSE NEW END).dataset_id;
    END IF;
    IF TG_OP <> 'INSERT' THEN
        PERFORM octasplat_count_content(whose, OLD.sha256, OLD.size_bytes, -1);
    END IF;
    IF TG_OP <> 'DELETE' THEN
        PERFORM octasplat_count_content(whose, NEW.sha256, NEW.size_bytes, 1);
    END IF;
    RETURN NULL;
END;
$$;
CREATE TRIGGER dataset_files_counted AFTER INSERT OR DELETE OR UPDATE OF sha256, size_bytes ON dataset_files
    FOR EACH ROW EXECUTE FUNCTION octasplat_count_files();
CREATE TRIGGER artifacts_counted AFTER INSERT OR DELETE OR UPDATE OF sha256, size_bytes ON artifacts
    FOR EACH ROW EXECUTE FUNCTION octasplat_count_files();

CREATE FUNCTION octasplat_count_checkpoint() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    before jsonb := coalesce(OLD.checkpoint->'files', '[]'::jsonb);
    after jsonb := '[]'::jsonb;
BEGIN
    IF TG_OP = 'UPDATE' THEN
        after := coalesce(NEW.checkpoint->'files', '[]'::jsonb);
    END IF;
    PERFORM octasplat_count_content(OLD.owner, changed.sha256, changed.size_bytes, changed.by) FROM (
        SELECT sha256, max(size_bytes) AS size_bytes, max(is_new) - max(was_there) AS by FROM (
            SELECT file->>'sha256' AS sha256, (file->>'size_bytes')::bigint AS size_bytes, 1 AS is_new, 0 AS was_there
            FROM jsonb_array_elements(after) AS file
            UNION ALL
            SELECT file->>'sha256', (file->>'size_bytes')::bigint, 0, 1 FROM jsonb_array_elements(before) AS file
        ) AS files GROUP BY sha256
    ) AS changed WHERE changed.by <> 0;
    RETURN NULL;
END;
$$;
CREATE TRIGGER jobs_checkpoint_counted AFTER UPDATE OF checkpoint ON jobs FOR EACH ROW
    WHEN (OLD.checkpoint IS DISTINCT FROM NEW.checkpoint) EXECUTE FUNCTION octasplat_count_checkpoint();
CREATE TRIGGER jobs_gone_counted AFTER DELETE ON jobs FOR EACH ROW
    WHEN (OLD.checkpoint IS NOT NULL) EXECUTE FUNCTION octasplat_count_checkpoint();

-- What is deleted along with a dataset or job is deleted before it, while it still says whose it was.
CREATE FUNCTION octasplat_delete_contents() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_TABLE_NAME = 'jobs' THEN
        DELETE FROM artifacts WHERE job_id = OLD.id;
    ELSE
        DELETE FROM dataset_files WHERE dataset_id = OLD.id;
    END IF;
    RETURN OLD;
END;
$$;
CREATE TRIGGER jobs_contents BEFORE DELETE ON jobs FOR EACH ROW EXECUTE FUNCTION octasplat_delete_contents();
CREATE TRIGGER datasets_contents BEFORE DELETE ON datasets FOR EACH ROW EXECUTE FUNCTION octasplat_delete_contents();
