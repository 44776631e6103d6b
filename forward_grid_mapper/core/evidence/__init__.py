"""The evidence of all readings, given a map: the gain of flipping each cell, kept up to date."""
