"""Parameters of the previous version that were removed or renamed."""

from __future__ import annotations

_CONSTANT = 'a constant of the model, which has the value of the paper with plain_model'

_CALIBRATED = 'no longer a parameter: the uncertainty map is calibrated, or that of the paper with end_cost 0'

DEPRECATED = {
    'bridges': 'no longer a parameter: gaps of up to 1 m are closed where end_cost is above 0',
    'cell_distance': 'no longer a parameter: distances are to the centers of cells; see surface_offset',
    'cut': 'no longer a parameter: the noise density is cut off at 4 sigma',
    'driven_cost': 'no longer a parameter: cells over which a sensor was moved are never occupied',
    'extend': 'no longer a parameter: straight walls are extended by up to 0.4 m where end_cost is above 0',
    'isolated_cost': 'no longer a parameter: a single cell costs two ends of a wall, twice end_cost',
    'least_noticed': _CONSTANT,
    'least_passed': _CONSTANT,
    'likelihood_exponent': _CONSTANT,
    'line_bonus': 'replaced by wall_cost: what a metre of wall costs, not what a cell of it gains',
    'live_depth': 'no longer a parameter: an echo marks an arc of 0.05 m, or half a cell, before and behind its range',
    'live_directions': _CONSTANT,
    'live_echo_width': _CONSTANT,
    'live_p_free_no_echo': _CONSTANT,
    'neighbour_weight': _CALIBRATED,
    'shift_moves': 'no longer a parameter: occupied cells are always tried to be moved to a neighbor',
    'surface_offset': _CONSTANT,
    'uncertainty_prior': _CALIBRATED,
}
"""Removed parameters of the previous version, with explanations. They are accepted with a warning and ignored."""


RENAMED = {
    'grazing_angle': 'max_incidence_angle',
    'max_sweeps': 'max_iterations',
}
"""Renamed parameters of the previous version, with the new names. They are accepted with a warning."""


def deprecation(name: str) -> str:
    """Return the warning for a name of `DEPRECATED` or `RENAMED`."""
    if name in RENAMED:
        return f'parameter {name} is called {RENAMED[name]} now; the next version will not accept the old name'
    return f'parameter {name} is ignored: it is {DEPRECATED[name]}'
