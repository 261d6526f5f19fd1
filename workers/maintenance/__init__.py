"""Periodic maintenance: expiry, garbage collection of the storage, and delivery of webhooks."""
