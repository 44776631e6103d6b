"""The named constants of the model: what decides about the maps, besides the parameters, with units and reasons.

Lengths are in metres and costs in nats a metre, so that the same drive gives the same map in cells of any size.
"""

from __future__ import annotations

# The sensor model

HIT_LENGTH = 0.1
"""Metres of surface that `p_hit` is for: a cell of the default resolution, so that there it is the paper's p_hit."""

MOST_HIT = 0.98
"""Largest probability that a cell returns the echo; freeing a cell divides by the rest."""

# Normals of surfaces

NEIGHBOURHOOD = 0.3
"""Edge in metres of the square whose echoes make the normal of the cell in its middle: three cells of 0.1 m. It holds
what one wall returns, and hardly anything of the next one."""

WEIGHT_CELL = 0.1
"""Edge in metres of the cells in which `LEAST_WEIGHT` counts. Smaller cells divide what one such cell receives."""

LEAST_WEIGHT = 3.0
"""Echoes, summed over the cells of `WEIGHT_CELL` in the square, that it takes to know a normal. One echo gives about
one to each cell on its arc, so this is one echo at the least, and mostly several."""

LEAST_AGREEMENT = 0.5
"""Length of the mean of the doubled bearings that it takes to know a normal; 1 where all agree, 0 where none do."""

THROUGH = 2.0
"""σ beyond a cell at which a range lies for the reading to have gone through: nearer ranges may be of the cell."""

# Surfaces that return echoes up to an incidence of their own

LEAST_RATE = 0.5
"""Part of the readings within the limit of a smooth surface that are its echoes. With 0.4 there are more dots."""

CONTRAST = 6.0
"""Times as large as that of the readings beyond."""

GAIN = 2.0
"""Nats by which two rates must be likelier than one."""

FEW_ECHOES, FEW_READINGS = 0.1, 0.2
"""Echoes and readings that are added, so that a rate is never 0 or 1."""

# The prior of walls

FORBIDDEN = 1e12
"""Nats that an occupied cell costs where a sensor was moved: more than the evidence of a cell can hold (2⁶³ units of
2⁻²⁴ nats), however long a robot stands before it, and still a finite number, so that its product with a weight of zero
is zero."""

# Gaps and short walls

LONGEST_GAP = 1.0
"""Metres. Gaps of chance between the echoes of a wall are shorter: with 0.6 m coverage is 0.01 less, with 1.5 m no
figure is better by as much."""

MOST_AGAINST_METRE = 10.0
"""Nats that may speak against a metre of a gap; no cell may have more than its part of them."""

MOST_AGAINST_GAP = 4.0
"""Nats that may speak against all of a gap."""

MOST_AGAINST_PASSAGE = 1.5
"""Nats that may speak against all of a gap that is wide enough to drive through: a few readings that went through."""

PASSAGE = 0.35
"""Metres of a gap from where on a robot might drive through: a small one, with some room."""

AWAY = -0.35
"""Largest cosine between the direction of a gap and that of the neighbours that its end has: 110° or more, so that it
may turn by the eighths of a turn that the lattice has, but not back along its wall."""

SHORT_WALL = 0.5
"""Metres of connected occupied cells, put end to end, that are removed at once: a few echoes that agree by chance make
no more, and twice as much changes nothing."""

# What is handed out

EXTENSION = 0.4
"""Metres by which a wall goes on at most. Between 0.3 and 1 m the maps hardly differ."""

STRAIGHT_RUN = 0.4
"""Metres of occupied cells in a row that make a straight wall; fewer are often in a row by chance."""

MOST_AGAINST_EXTENSION = 0.5
"""Nats that may speak against a metre by which a wall goes on: the tails of readings that end before it."""

FREE_MARGIN = 0.1
"""Metres around a cell known to be free within which others are free, if nothing occupies them. Without it a fringe of
unknown cells stands before every wall."""

LED_ON = 0.3
"""Metres by which free space goes on, through cells that some readings passed, from those that no surface could be in
without readings having noticed it. With less, doors that one sweep looked through are shut, with more, more of what
lies behind holes in walls is free. With `FREE_MARGIN` it is less than the margin of tiles, half of `LONGEST_GAP`."""

STANDS_OFF = 0.3
"""Metres before a cell from where on what is occupied does not stand in its way: it is of the same wall."""

LEAST_FREE_WAY = 0.33
"""Part of the echoes around a cell that must have come on a free way for it to be no mirror image. With a quarter as
with a half F1 is within 0.001, and with more than 0.6 true walls go."""

LEAST_STRENGTH = 0.25
"""Of a beam at a cell, for it to have passed there on a free way."""

IMAGE_AROUND = 0.45
"""Metres around a cell whose echoes decide about it, less than the margin of tiles, half of `LONGEST_GAP`. With less,
cells of true walls go."""

LEAST_EVIDENCE = 0.1
"""Nats, either way, from which on a cell counts as observed though the maximum likelihood map does not know it."""

LEAST_LOOK = 0.1
"""Readings that it takes as well, of those that any surface there would have noticed, where they speak against one."""

# The standard map

ARC = (0.05, 0.1)
"""Metres before and behind its range that an echo marks as occupied: the σ of a usual sonar, and twice that behind,
since an arc bends away from a wall towards the sensor. With 0.15 m behind, walls of the maps are too thick."""


def arc_depths(resolution: float, arc: tuple[float, float] = ARC) -> tuple[float, float]:
    """Return how deep an echo marks before and behind its range, metres: no less than half a cell of `resolution`."""
    before, behind = arc
    return max(before, resolution / 2), max(behind, resolution / 2)
