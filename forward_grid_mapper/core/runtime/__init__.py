"""Compilation and threads."""
