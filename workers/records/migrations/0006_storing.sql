-- Who stores contents at the moment and is about to name them; none of these contents is collected.

CREATE TABLE storing (
    id uuid PRIMARY KEY,
    began_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    seen_at timestamptz NOT NULL DEFAULT clock_timestamp()
);
