-- Files beside the photographs that the options of a job name, such as the meshes of a stage.

ALTER TABLE datasets ADD COLUMN holds text NOT NULL DEFAULT 'photographs' CHECK (holds IN ('photographs', 'files'));
ALTER TABLE jobs ADD COLUMN files_id uuid REFERENCES datasets ON DELETE RESTRICT;
CREATE INDEX jobs_files ON jobs (files_id);
