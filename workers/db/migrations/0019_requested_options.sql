-- Options as they were asked for; `options` is what a front end made of them, for workers that know no others.
ALTER TABLE jobs ADD COLUMN requested jsonb;

-- A front end of the former version that changes the options knows nothing of what they were asked as.
CREATE FUNCTION octasplat_forget_requested_options() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    NEW.requested := NULL;
    RETURN NEW;
END
$$;
CREATE TRIGGER jobs_requested_forgotten BEFORE UPDATE OF options ON jobs FOR EACH ROW
WHEN (NEW.options IS DISTINCT FROM OLD.options AND NEW.requested IS NOT DISTINCT FROM OLD.requested)
EXECUTE FUNCTION octasplat_forget_requested_options();
