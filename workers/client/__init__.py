"""Client of the service: uploads, jobs, progress and downloads, over HTTP only; prints nothing."""
