-- Uploads of one large file each, in parts that are kept, so that they go on after a break of the connection, the client or
-- the service.

CREATE TABLE uploads (
    id uuid PRIMARY KEY,
    dataset_id uuid NOT NULL REFERENCES datasets ON DELETE CASCADE,
    owner text NOT NULL,
    path text,
    size_bytes bigint NOT NULL CHECK (size_bytes > 0),
    sha256 text,
    metadata text NOT NULL,
    offset_bytes bigint NOT NULL DEFAULT 0 CHECK (offset_bytes <= size_bytes),
    task_id uuid,
    created_at timestamptz NOT NULL DEFAULT now(),
    expires_at timestamptz NOT NULL
);
CREATE INDEX uploads_dataset ON uploads (dataset_id);
CREATE INDEX uploads_owner ON uploads (owner);

-- Whose a part is stands in its row, as the upload may be gone when it is counted.
CREATE TABLE upload_parts (
    upload_id uuid NOT NULL REFERENCES uploads ON DELETE CASCADE,
    start_bytes bigint NOT NULL,
    owner text NOT NULL,
    sha256 text NOT NULL,
    size_bytes bigint NOT NULL,
    PRIMARY KEY (upload_id, start_bytes)
);

-- Parts count as the files of datasets do, which also keeps them from being collected.
CREATE FUNCTION octasplat_count_upload_parts() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP = 'DELETE' THEN
        PERFORM octasplat_count_contents(owner, array_agg(sha256), array_agg(size_bytes), array_agg(-1))
        FROM removed GROUP BY owner;
    ELSE
        PERFORM octasplat_count_contents(owner, array_agg(sha256), array_agg(size_bytes), array_agg(1))
        FROM added GROUP BY owner;
    END IF;
    RETURN NULL;
END;
$$;
CREATE TRIGGER upload_parts_added AFTER INSERT ON upload_parts
    REFERENCING NEW TABLE AS added FOR EACH STATEMENT EXECUTE FUNCTION octasplat_count_upload_parts();
CREATE TRIGGER upload_parts_removed AFTER DELETE ON upload_parts
    REFERENCING OLD TABLE AS removed FOR EACH STATEMENT EXECUTE FUNCTION octasplat_count_upload_parts();

-- As before, with the parts of uploads.
CREATE OR REPLACE FUNCTION octasplat_recount() RETURNS TABLE (whose text, bytes_before bigint, bytes_after bigint)
LANGUAGE plpgsql AS $$
BEGIN
    LOCK TABLE jobs, datasets, dataset_files, artifacts, upload_parts, owner_contents, owner_usage IN SHARE ROW EXCLUSIVE MODE;
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
        SELECT u.owner, u.sha256, u.size_bytes FROM upload_parts u
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
