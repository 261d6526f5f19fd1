"""Events and numbers in words, for whoever shows them: the command line, the logs of jobs, the client."""
