"""How good a reconstruction is: image metrics, per-view results and the report page."""
