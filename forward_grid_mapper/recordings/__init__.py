"""Recorded drives, from bags and journals, as readings and data for the report."""
