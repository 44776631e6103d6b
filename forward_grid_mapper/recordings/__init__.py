"""Recorded drives, from bags and journals, as readings and an account of how they came about."""
