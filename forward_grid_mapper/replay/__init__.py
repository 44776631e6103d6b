"""Plays a recorded drive for the node."""
