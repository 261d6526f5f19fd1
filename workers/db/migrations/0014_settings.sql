-- What a job's options became where it ran, and by which version; the options themselves leave defaults out.
ALTER TABLE jobs ADD COLUMN settings jsonb, ADD COLUMN resolved_by text;
