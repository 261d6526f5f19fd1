-- What the owner of a job should know: why it waits in the queue, and why it was begun anew.

ALTER TABLE jobs ADD COLUMN waits_for text, ADD COLUMN begun_anew text;
