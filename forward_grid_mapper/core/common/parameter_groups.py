"""The groups of parameters: the single source of their names, defaults, units, ranges and help texts.

The dataclasses are the table of parameters (`parameters.TABLE`). Fields that are made with `constant` are no parameters
(`parameters.CONSTANTS`): they have two values, the default, and that of `plain_model`, which is that of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

from .errors import ParameterError
from .parameter import constant, param


@dataclass(frozen=True)
class AssociationParameters:
    """From messages to readings in the map frame."""

    max_pose_gap: float = param(
        1.0,
        'Longest gap between two odometry messages that is interpolated; readings in a longer gap are rejected.',
        's',
        0.001,
        60.0,
    )
    pose_timeout: float = param(
        2.0,
        'How long, by message stamps, a reading waits for odometry that has stopped; keep it above max_pose_gap.',
        's',
        0.01,
        600.0,
    )
    range_time_offset: float = param(
        0.0,
        'Seconds that are added to the stamps of Range messages: less than 0 if drivers stamp readings too late. The '
        'report names the value that fits a drive.',
        's',
        -2.0,
        2.0,
    )
    over_range: str = param(
        'no_echo',
        'What +inf and ranges at or beyond max_range mean: no echo within max_range, or no information.',
        choices=('no_echo', 'discard'),
    )
    invalid_range: str = param(
        'discard',
        'What NaN, 0 and negative ranges other than -inf mean: no information, or no echo within max_range. Set '
        'no_echo if the driver sends them when there is no echo. Keep discard if it also sends them for objects that '
        'are too near.',
        choices=('discard', 'no_echo'),
    )
    field_of_view: float = param(
        0.0, "Full cone angle to use instead of the messages'; 0 uses theirs.", 'rad', 0.0, 3.1
    )
    max_range: float = param(0.0, "Largest range to use instead of the messages'; 0 uses theirs.", 'm', 0.0, 1000.0)
    max_jump: float = param(
        1000.0,
        'A reading farther than this from the area mapped before is rejected, so that an outlier pose does not make '
        'the map huge.',
        'm',
        1.0,
        1e7,
    )
    max_readings: int = param(
        500_000,
        'Number of readings that are kept for mapping. Beyond it, the oldest are removed where a sensor measured most '
        'often from one place in one direction. 0 keeps all.',
        'readings',
        0,
        100_000_000,
        read_only=True,
    )
    odometry_noise: float = param(
        0.0,
        'Random drift of the yaw of odometry in one metre of driving (standard deviation; it grows with the square '
        'root of the distance), for refine_poses. Usual for wheels is 0.01 to 0.08; 0 estimates it from the drive.',
        'rad',
        0.0,
        0.5,
    )


@dataclass(frozen=True)
class GridParameters:
    """The grid of cells; its extent follows the readings."""

    resolution: float = param(0.1, 'Edge length of a cell.', 'm', 0.005, 2.0, read_only=True)
    max_cells: int = param(
        50_000_000,
        'Bound on the cells of a map; a reading that would make the grid larger is rejected.',
        'cells',
        10_000,
        1_000_000_000,
        read_only=True,
    )


@dataclass(frozen=True)
class ModelParameters:
    """The forward sensor model: why a reading is what it is.

    p_rand and p_lost are larger than those of any one sonar, and no estimates: together they bound what a single
    reading can say to about a nat and a half, and one without echo to a seventh of a nat (`sensor.bounds`). So no wall
    hangs on one reading, and smooth walls, which many readings meet without an echo, stand by the few that heard them.
    """

    plain_model: bool = param(
        False,
        'Use the plain model of the paper: the constants of the model (docs/parameters.md) have their plain values. '
        'config/paper.yaml has the other values of the paper.',
        read_only=True,
    )
    p_hit: float = param(
        0.65,
        'Probability that 0.1 m of a surface in the cone returns the echo; it does not depend on the cell size.',
        'probability',
        0.01,
        0.98,
    )
    p_rand: float = param(
        0.4, 'Probability that a reading is a random measurement, independent of the map.', 'probability', 1e-4, 0.95
    )
    p_lost: float = param(
        0.52,
        'Probability that the echo is lost, independent of the map, for example by reflection off smooth walls; 0 is '
        "the paper's model.",
        'probability',
        0.0,
        0.95,
    )
    sigma: float = param(
        0.1,
        'Standard deviation of a range if the message states no variance; at least half a cell is used.',
        'm',
        0.001,
        5.0,
    )
    max_incidence_angle: float = param(
        0.7,
        'Incidence angle, from the normal of a surface, above which a reading that passes does not contradict the '
        'surface; with pi/2 every reading contradicts it.',
        'rad',
        0.1,
        1.5708,
    )
    min_incidence_angle: float = constant(
        0.31,
        1.5708,
        'Smallest limit of the incidence angle that is estimated for a surface, as for a smooth wall or glass. A '
        'surface in an empty cell has the middle of both limits or max_incidence_angle, so a cell that is seen in one '
        'direction needs more readings to be free. If it is max_incidence_angle or more, all surfaces have '
        'max_incidence_angle.',
        'rad',
    )
    surface_offset: float = constant(
        0.3, 0.0, 'Distance of the surface of an obstacle in front of the center of its cell.', 'cells'
    )
    likelihood_exponent: float = constant(
        1.0,
        1.0,
        'Weight of the readings relative to the prior: the exponent of p(Z | m). Below 1, it reduces the evidence of '
        'readings that are not independent.',
    )

    def __post_init__(self) -> None:
        if self.p_rand + self.p_lost > 0.99:
            raise ParameterError(
                f'p_rand = {self.p_rand:g} and p_lost = {self.p_lost:g} leave no probability for the map; their sum '
                'must not exceed 0.99'
            )


@dataclass(frozen=True)
class SearchParameters:
    """The search for the maximum likelihood map, and its uncertainty."""

    prior: float = param(
        0.4,
        'Prior probability of an occupied cell in the first part of the search, in which cells are independent, and '
        "in the uncertainty map if there is no second part. 0.5 is the paper's plain ML; less removes dots and thins "
        'walls.',
        'probability',
        1e-6,
        0.5,
    )
    wall_cost: float = param(1.0, 'Cost of a metre of wall in the second part of the search.', 'nats/m', 0.0, 1000.0)
    end_cost: float = param(
        1.3,
        'Cost of an end of a wall, or of a corner, in the second part of the search; a single cell has two ends. With '
        '0 there is no second part: gaps stay open and walls are not extended, as in the paper.',
        'nats',
        0.0,
        100.0,
    )
    least_passed: float = constant(
        0.88,
        0.0,
        'A cell is free only if at least this number of readings is expected to have passed through it; with 0 every '
        'cell that was seen is free.',
        'readings',
    )
    least_noticed: float = constant(
        1.0,
        0.0,
        'Floor is free only if the readings from different directions amount to at least this number of readings that '
        'would detect a wall of any orientation; with 0 floor is free if it was seen from any direction.',
        'readings',
    )
    max_iterations: int = param(
        1000, 'Bound on the iterations of the search; the report says if it was reached.', 'iterations', 1, 100_000
    )
    threads: int = param(
        0,
        'Threads of a search, and of scan matching; 0 for one per core. Maps and trajectories do not depend on it.',
        'threads',
        0,
        256,
    )
    max_memory: int = param(
        4000,
        'Memory for pairs of cells and readings; beyond it they are computed again each time: the same maps, slower.',
        'MB',
        0,
        1_000_000,
    )
    alpha: float = param(1.0, 'Weight of the evidence in the uncertainty map, (45) of the paper.', '', 0.0, 1.0)


@dataclass(frozen=True)
class LiveMapParameters:
    """The standard map: log odds ((3), (4), (14)-(16) of the paper), updated with each reading."""

    live_p_occupied: float = param(
        0.99,
        'Occupancy of a cell on the axis at the measured range, given one reading whose arc is no longer than '
        'live_echo_width.',
        'probability',
        0.5,
        0.999,
        read_only=True,
    )
    live_p_free: float = param(
        0.01,
        'Occupancy of a cell on the axis in front of the measured range, given one reading.',
        'probability',
        0.001,
        0.5,
        read_only=True,
    )
    live_p_free_no_echo: float = constant(
        0.34,
        0.3,
        'Occupancy of a cell on the axis, given one reading without an echo; the echo may be lost.',
        'probability',
    )
    live_echo_width: float = constant(
        0.2,
        1000.0,
        'Length of surface for which an echo is evidence; in a longer arc, the evidence for each cell is smaller in '
        'proportion. With 1000 every cell gets the full evidence.',
        'm',
    )
    live_directions: int = constant(
        4,
        1,
        'Number of directions of measurement, over half a turn, whose readings are summed separately, so that readings '
        'at large incidence angles do not remove walls.',
        'directions',
    )


@dataclass(frozen=True)
class NodeParameters:
    """Topics, frames and output of the node; the offline tool has options for them."""

    range_topics: tuple[str, ...] = param(('sonar',), 'Topics of sensor_msgs/Range, one or many.', read_only=True)
    odom_topic: str = param('odom', 'Topic of nav_msgs/Odometry.', read_only=True)
    range_reliability: str = param(
        'best_effort',
        'Quality of service of the Range subscriptions. With reliable, lost messages are sent again; it needs reliable '
        'publishers.',
        choices=('best_effort', 'reliable'),
        read_only=True,
    )
    odom_reliability: str = param(
        'best_effort', 'The same for odometry.', choices=('best_effort', 'reliable'), read_only=True
    )
    map_frame: str = param(
        '',
        'Frame of the maps, if it is not that of odometry. The transform between the two comes from TF; with '
        "refine_poses this node publishes it, and the default frame is 'map'.",
        read_only=True,
    )
    refine_poses: bool = param(
        False,
        'Correct the drift of odometry when run_em is called, and publish the transform from map to odom. Works best '
        'if walls are at right angles. Odometry is kept unless held-out readings support the correction.',
    )
    refine_every: float = param(
        0.0,
        'With refine_poses, distance driven after which the node runs EM by itself, so that the transform from map to '
        'odom follows the drift; at least a metre. Later runs wait until the drive has grown by a tenth. 0: EM runs '
        'only when run_em is called.',
        'm',
        0.0,
        1e6,
    )
    online: bool = param(
        False,
        'Update the maximum likelihood map and the uncertainty map with every reading, and start EM from them. With '
        'refine_poses, also correct odometry while the robot drives, from the end of the latest trajectory on.',
        read_only=True,
    )
    publish_rate: float = param(
        1.0, 'Largest rate of live maps, of online maps, and of maps published while EM is running.', 'Hz', 0.01, 50.0
    )
    journal: str = param(
        '',
        'Folder of the journal, which keeps every accepted reading on disk and restores them after a restart; empty: '
        'no journal.',
        read_only=True,
    )
    autostart: bool = param(
        True,
        'Configure and activate the node at its start; if false, a lifecycle manager does this.',
        read_only=True,
    )
    save_directory: str = param('~/forward_grid_mapper', 'Folder in which save_maps makes a new folder at each call.')
