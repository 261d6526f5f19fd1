-- Who stores contents at the moment and is about to name them; none of these contents is collected.

CREATE TABLE storing (
    id uuid PRIMARY KEY,
    began_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    seen_at timestamptz NOT NULL DEFAULT clock_timestamp()
);

-- The PSNR of a job is that of the views that training never saw; what it was so far is the training's own.

ALTER TABLE jobs ADD COLUMN training_psnr double precision;
UPDATE jobs SET training_psnr = psnr, psnr = (
    SELECT (data->>'psnr')::double precision FROM job_events
    WHERE job_id = jobs.id AND kind = 'held_out_measured' ORDER BY id DESC LIMIT 1
) WHERE psnr IS NOT NULL;
