-- What the 3D view shows besides results: states of trainings, each replaced by the next, and notes.

CREATE TABLE live_scenes (
    job_id uuid PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
    sha256 text NOT NULL,
    views_sha256 text NOT NULL,
    step integer NOT NULL,
    gaussians integer NOT NULL
);

CREATE FUNCTION octasplat_remember_live_scene() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO replaced_contents (sha256)
    SELECT DISTINCT old_content FROM unnest(ARRAY[OLD.sha256, OLD.views_sha256]) AS old_content
    WHERE TG_OP = 'DELETE' OR old_content NOT IN (NEW.sha256, NEW.views_sha256)
    ORDER BY 1
    ON CONFLICT (sha256) DO UPDATE SET replaced_at = now();
    RETURN NULL;
END;
$$;
CREATE TRIGGER live_scenes_replaced AFTER UPDATE OR DELETE ON live_scenes FOR EACH ROW
    EXECUTE FUNCTION octasplat_remember_live_scene();

-- Notes that people put at places of the 3D view: text, position, and the camera that they were made from.
ALTER TABLE jobs ADD COLUMN view_notes jsonb NOT NULL DEFAULT '[]';
