"""One module a command; each imports only what its help text needs until it runs."""
