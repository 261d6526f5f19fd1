-- What an owner may take; an absent row or value leaves it to the settings.

CREATE TABLE quotas (
    owner text PRIMARY KEY,
    max_bytes bigint CHECK (max_bytes >= 0),
    max_datasets integer CHECK (max_datasets >= 0),
    max_jobs integer CHECK (max_jobs >= 0)
);
