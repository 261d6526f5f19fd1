-- Events and lines of the log are numbered by job, so that their numbers tell nothing of other jobs.

CREATE TABLE job_counts (
    job_id uuid PRIMARY KEY REFERENCES jobs ON DELETE CASCADE,
    events bigint NOT NULL,
    log_lines bigint NOT NULL
);
ALTER TABLE job_events ADD COLUMN number bigint;
ALTER TABLE job_logs ADD COLUMN number bigint;
CREATE INDEX job_events_number ON job_events (job_id, number);
CREATE INDEX job_logs_number ON job_logs (job_id, number);

-- Counts rows that are about to be added to a job; returns the count with them. Whoever adds others waits for the
-- end of the transaction, so that numbers appear in their order.
CREATE FUNCTION octasplat_count_job_rows(of_job uuid, new_events bigint, new_lines bigint) RETURNS job_counts
LANGUAGE plpgsql AS $$
DECLARE
    counted job_counts;
BEGIN
    UPDATE job_counts SET events = events + new_events, log_lines = log_lines + new_lines
    WHERE job_id = of_job RETURNING * INTO counted;
    IF NOT FOUND THEN
        -- Rows of the version before have no numbers yet; the next step gives them the first ones.
        INSERT INTO job_counts AS known (job_id, events, log_lines) VALUES (
            of_job,
            (SELECT count(*) FROM job_events WHERE job_id = of_job) + new_events,
            (SELECT count(*) FROM job_logs WHERE job_id = of_job) + new_lines
        )
        ON CONFLICT (job_id) DO UPDATE
        SET events = known.events + new_events, log_lines = known.log_lines + new_lines
        RETURNING known.* INTO counted;
    END IF;
    RETURN counted;
END;
$$;

-- Rows that come without a number: events, and lines of processes of the version before.
CREATE FUNCTION octasplat_number_job_row() RETURNS trigger LANGUAGE plpgsql AS $$
DECLARE
    counted job_counts;
BEGIN
    IF TG_TABLE_NAME = 'job_events' THEN
        counted := octasplat_count_job_rows(NEW.job_id, 1, 0);
        NEW.number := counted.events;
    ELSE
        counted := octasplat_count_job_rows(NEW.job_id, 0, 1);
        NEW.number := counted.log_lines;
    END IF;
    RETURN NEW;
END;
$$;
CREATE TRIGGER job_events_numbered BEFORE INSERT ON job_events FOR EACH ROW
    WHEN (NEW.number IS NULL) EXECUTE FUNCTION octasplat_number_job_row();
CREATE TRIGGER job_logs_numbered BEFORE INSERT ON job_logs FOR EACH ROW
    WHEN (NEW.number IS NULL) EXECUTE FUNCTION octasplat_number_job_row();
