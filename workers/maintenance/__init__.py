"""What is done regularly: forgetting what has expired, collecting what nobody names, sending webhooks."""
