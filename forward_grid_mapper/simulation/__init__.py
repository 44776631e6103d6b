"""Small worlds with ground truth, simulated sonars, drives through them, and scores of their maps."""
