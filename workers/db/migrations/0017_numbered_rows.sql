-- Numbers of the events and lines that were there before; a step of its own, as nobody waits for it.

UPDATE job_events SET number = ranked.place
FROM (
    SELECT id, row_number() OVER (PARTITION BY job_id ORDER BY id) AS place FROM job_events WHERE number IS NULL
) ranked
WHERE job_events.id = ranked.id;
UPDATE job_logs SET number = ranked.place
FROM (
    SELECT id, row_number() OVER (PARTITION BY job_id ORDER BY id) AS place FROM job_logs WHERE number IS NULL
) ranked
WHERE job_logs.id = ranked.id;
INSERT INTO job_counts (job_id, events, log_lines)
SELECT id,
    (SELECT count(*) FROM job_events WHERE job_id = jobs.id),
    (SELECT count(*) FROM job_logs WHERE job_id = jobs.id)
FROM jobs
ON CONFLICT (job_id) DO NOTHING;
