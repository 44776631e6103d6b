"""The constants of the model that affect the maps and are no parameters, with units and reasons.

Lengths are in metres and costs in nats a metre, so that maps do not depend on the cell size.
"""

from __future__ import annotations

# The sensor model

HIT_LENGTH = 0.1
"""Metres of surface that `p_hit` is given for: a cell of the default resolution, where it is the p_hit of the paper."""

MOST_HIT = 0.98
"""Largest probability that a cell returns the echo; freeing a cell divides by the rest."""

FARTHEST_RANDOM = 1000.0
"""Largest range of a random measurement, metres: that of the parameter `max_range`. Drivers that know no largest range
send the largest number; a density of nearly zero would give single readings more weight than all others together, and
likelihood ratios that no float32 can represent."""

# Normals of surfaces

NEIGHBOURHOOD = 0.3
"""Side of the square whose echoes give the normal of the cell in its middle, metres: three cells of 0.1 m. It contains
the echoes of one wall, and hardly any of the next one."""

WEIGHT_CELL = 0.1
"""Size of the cells that `LEAST_WEIGHT` is given for, metres. Smaller cells share the weight of one such cell."""

LEAST_WEIGHT = 3.0
"""Least weight for a known normal: echoes, summed over the cells of `WEIGHT_CELL` in the square. One echo adds about
one to each cell on its arc, so this is at least one echo, and mostly several."""

LEAST_AGREEMENT = 0.5
"""Least length of the mean of the doubled bearings for a known normal; 1 if all agree, 0 if none do."""

THROUGH = 2.0
"""A reading passed a cell if its range is this many σ beyond it; shorter ranges may be echoes of the cell."""

# Smooth surfaces, with a learned limit of the incidence angle

LEAST_RATE = 0.5
"""Least fraction of the readings within the limit that are echoes of the surface. With 0.4, maps have more dots."""

CONTRAST = 6.0
"""This rate must be this many times that of the readings beyond the limit."""

GAIN = 2.0
"""Nats by which two rates, within and beyond the limit, must be likelier than one."""

FEW_ECHOES, FEW_READINGS = 0.1, 0.2
"""Echoes and readings that are added to the counts, so that a rate is never 0 or 1."""

# The prior of walls

FORBIDDEN = 1e12
"""Cost of an occupied cell where a sensor was, nats: more than the evidence of a cell can be (2⁶³ units of 2⁻²⁴ nats),
however long the robot stood in front of it, and finite, so that its product with a weight of zero is zero."""

# Gaps and short walls

LONGEST_GAP = 1.0
"""Longest gap that is closed, metres. Gaps by chance between the echoes of a wall are shorter: with 0.6 m, coverage is
0.01 less; with 1.5 m, no result is better by as much."""

MOST_AGAINST_METRE = 10.0
"""Largest evidence against a metre of a gap that is closed, nats; each cell may have its share of it at most."""

MOST_AGAINST_GAP = 4.0
"""Largest evidence against a whole gap that is closed, nats."""

MOST_AGAINST_PASSAGE = 1.5
"""The same for a gap that is wide enough to drive through, nats: a few readings that passed."""

PASSAGE = 0.35
"""Width of a gap that a small robot could drive through, metres."""

AWAY = -0.35
"""Largest cosine between the direction of a gap and that of the neighbours of its end: the angle is 110° or more, so
that the gap may turn by an eighth of a turn, as the lattice does, but not back along its wall."""

SHORT_WALL = 0.5
"""Total length of connected occupied cells up to which they may be removed together, metres: a few echoes that agree by
chance make no more. Twice as much changes nothing."""

# The final maps

EXTENSION = 0.4
"""Largest extension of a wall, metres. Between 0.3 and 1 m the maps hardly differ."""

STRAIGHT_RUN = 0.4
"""Least length of a straight row of occupied cells that is extended, metres; shorter ones are often due to chance."""

MOST_AGAINST_EXTENSION = 0.5
"""Largest evidence against a metre of an extension, nats: the tails of readings that end before it."""

FREE_MARGIN = 0.1
"""Metres around a cell known to be free within which cells are free as well if not occupied. Without it, there would be
a fringe of unknown cells in front of all walls."""

FREE_GROWTH = 0.3
"""Metres by which free space grows, through cells that some readings passed, from cells in which readings would have
detected any surface. With less, doors that were seen in one sweep are closed; with more, more space behind holes in
walls is free. With `FREE_MARGIN` it is less than the margin of tiles, half of `LONGEST_GAP`."""

SAME_WALL = 0.3
"""Metres in front of a cell within which occupied cells belong to the same wall, and do not block the line of sight."""

LEAST_IN_SIGHT = 0.33
"""Fraction of the echoes around a cell that must have come in line of sight; otherwise it is a mirror image. F1 differs
by at most 0.001 between a quarter and a half; with more than 0.6, cells of true walls are lost."""

LEAST_STRENGTH = 0.25
"""Least strength of a beam at a cell that it passed in line of sight."""

IMAGE_AROUND = 0.45
"""Metres around a cell whose echoes decide whether it is a mirror image; less than the margin of tiles, half of
`LONGEST_GAP`. With less, cells of true walls are lost."""

LEAST_EVIDENCE = 0.1
"""Least |evidence| of a cell that is observed although it is unknown on the maximum likelihood map, nats."""

LEAST_NOTICING = 0.1
"""If the evidence is against an obstacle, such a cell needs this many readings that would have detected any surface."""

# The standard map

ARC = (0.05, 0.1)
"""Depths of the arc that an echo marks as occupied, before and behind its range, metres: σ of a usual sonar, and twice
that behind, since an arc bends away from a wall towards the sensor. With 0.15 m behind, walls are too thick."""


def arc_depths(resolution: float, arc: tuple[float, float] = ARC) -> tuple[float, float]:
    """Return the depths of the arc before and behind the range of an echo, metres, at least half a cell."""
    before, behind = arc
    return max(before, resolution / 2), max(behind, resolution / 2)
