"""The service from the outside: uploads, jobs, progress, downloads, over HTTP only; prints nothing."""
