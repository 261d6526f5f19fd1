"""Events and figures as text for the command line, the logs of jobs and the client."""
