"""Maps of more than one process holds: readings on disk by tile, and tiles worked on by Dask's workers.

It needs the extra *scale*; nothing else of the package imports it but the command that asks for it. `starting` alone is
for all commands that start processes, and needs nothing.
"""
