-- When a job of an owner was last begun in a queue: owners take turns.

CREATE TABLE owner_turns (
    owner text NOT NULL,
    queue text NOT NULL,
    turn_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    PRIMARY KEY (owner, queue)
);
