"""Webhooks that notify other programs of job events (https://www.standardwebhooks.com).

A trigger writes a row for every message in the transaction that changes the job; workers send what is due. A
message is sent at least once, always with the same id and body.
"""
