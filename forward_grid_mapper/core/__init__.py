"""The mathematics of mapping: from messages to three maps, with numpy and numba only."""
