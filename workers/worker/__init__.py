"""Workers: a supervisor that uses the database and the storage; the work runs in a child process."""
