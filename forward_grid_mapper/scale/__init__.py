"""Maps larger than the memory of one process: readings on disk by tile, and tiles processed by workers of Dask.

It requires the extra *scale*, and is imported only by the command that needs it. Only `starting` is for all commands
that start processes, and requires nothing.
"""
