"""Evaluation of a reconstruction: image metrics, results per view and the report page."""
