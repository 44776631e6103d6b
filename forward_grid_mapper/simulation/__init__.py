"""Small worlds with known ground truth, sonars that measure them, drives through them, and scores of their maps."""
