-- Sessions of browsers, links that sign in once, where a token comes from, and who did what.
-- Tables of their own: processes of the version before read tokens with all columns that there are.

-- A token that was shut out stays so, whoever starts with it again.
CREATE FUNCTION octasplat_keep_revoked() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    NEW.revoked_at := OLD.revoked_at;
    RETURN NEW;
END;
$$;
CREATE TRIGGER tokens_stay_revoked BEFORE UPDATE ON tokens FOR EACH ROW
    WHEN (OLD.revoked_at IS NOT NULL) EXECUTE FUNCTION octasplat_keep_revoked();

-- Tokens that nobody made by name: that of OCTASPLAT_TOKEN, and those of machines that run octasplat serve.
CREATE TABLE token_origins (
    token_id uuid PRIMARY KEY REFERENCES tokens ON DELETE CASCADE,
    origin text NOT NULL CHECK (origin IN ('environment', 'machine'))
);
INSERT INTO token_origins SELECT id, 'environment' FROM tokens WHERE name = 'OCTASPLAT_TOKEN' AND owner = 'admin';

CREATE TABLE sessions (
    id uuid PRIMARY KEY,
    token_id uuid NOT NULL REFERENCES tokens ON DELETE CASCADE,
    sha256 text NOT NULL UNIQUE,
    created_at timestamptz NOT NULL DEFAULT now(),
    expires_at timestamptz NOT NULL,
    revoked_at timestamptz
);
CREATE INDEX sessions_token ON sessions (token_id);

CREATE TABLE sign_in_links (
    sha256 text PRIMARY KEY,
    token_id uuid NOT NULL REFERENCES tokens ON DELETE CASCADE,
    expires_at timestamptz NOT NULL
);

CREATE TABLE audit (
    id bigint PRIMARY KEY GENERATED ALWAYS AS IDENTITY,
    at timestamptz NOT NULL DEFAULT clock_timestamp(),
    owner text,
    token_id uuid,
    session_id uuid,
    address text NOT NULL,
    action text NOT NULL,
    target text,
    status integer NOT NULL
);
