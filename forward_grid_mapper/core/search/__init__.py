"""The search for the maximum likelihood map, and the prior of maps."""
