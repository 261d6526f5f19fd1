-- What a job was reckoned to take when it was accepted.

ALTER TABLE jobs ADD COLUMN estimate jsonb;
