-- Counts removals of unused contents: whoever stored something without one meanwhile need not look whether it is there.

CREATE SEQUENCE octasplat_removals;
CREATE INDEX owner_contents_sha256 ON owner_contents (sha256);
