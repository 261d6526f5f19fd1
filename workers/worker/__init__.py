"""Workers: a small supervisor that talks to the database and the store, the work in a child process."""
