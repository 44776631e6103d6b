"""Drives with refined trajectories: each is estimated and judged separately, for one map of all."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.common.parameters import Parameters
from ..core.common.readings import Readings, of_drives
from ..core.maps.map_set import MapSet
from ..core.messages.reading_buffer import bounded
from ..core.trajectory.certainty import YAW_ERRORS, CalibrationEstimate, combined_calibration, determined_calibration
from ..core.trajectory.odometry_model import CALIBRATION, calibrated
from ..core.trajectory.outcome import Refinement, replaced
from ..core.trajectory.poses import relative
from ..core.trajectory.recovering import recovered
from ..core.trajectory.registration import moved_to, readings_moved, register
from ..core.trajectory.windows import Odometry
from ..files.calibration_file import calibration_text
from ..files.output_folder import readable
from ..files.panels import joined_paths
from ..files.trajectory_text import trajectory_data, trajectory_files
from .drive import Drive
from .drives import Drives

Watch = Callable[[str, float], None]
"""Receives the current stage, and its progress from 0 to 1."""

NO_MOUNTS = (
    'a journal contains no odometry. It can be computed from the readings of sensors that are fixed to the robot, '
    'but this journal has no poses of them: give their poses with --sensor, or the parameter file of the node with '
    '--params'
)

NO_TIMES = (
    "no calibration is applied: there are readings at times without odometry, as after a jump of odometry's clock"
)


@dataclass(frozen=True)
class RefinedDrives:
    """Drives, and the trajectory of each, in their order.

    Attributes
    ----------
    drives : Drives
    odometry : tuple of Odometry
        As recorded.
    outcomes : tuple of Refinement
    estimates : tuple of dict
        The calibration that each drive with a refined trajectory determines.
    """

    drives: Drives
    odometry: tuple[Odometry, ...]
    outcomes: tuple[Refinement, ...]
    estimates: tuple[dict[str, CalibrationEstimate], ...]

    @property
    def moved(self) -> bool:
        """Whether any drive has another trajectory than that of odometry."""
        return any(_moved(odometry, outcome) for _, odometry, outcome in self._each)

    @property
    def readings(self) -> Readings:
        """The readings to map from; those of `Drives.readings` if no drive moved."""
        if not self.moved:
            return self.drives.readings
        if len(self.outcomes) == 1:
            return self.outcomes[0].readings
        parts = []
        for drive, odometry, outcome in self._each:
            held = drive.associator.buffer.snapshot()
            parts.append(replaced(held, odometry, outcome.trajectory) if _moved(odometry, outcome) else held)
        return bounded(of_drives(parts), self.drives.parameters.association.max_readings)

    @property
    def path_xy(self) -> NDArray[np.float64]:
        """Paths of the robots, shape (P, 2), metres; separated by rows of NaN."""
        paths = [
            outcome.trajectory.pose[:, :2] if _moved(odometry, outcome) else drive.path_xy
            for drive, odometry, outcome in self._each
        ]
        return joined_paths(paths)

    @property
    def odometry_xy(self) -> NDArray[np.float64]:
        """The paths of odometry of the drives that moved, as `path_xy`; empty if none did."""
        return joined_paths([drive.path_xy for drive, odometry, outcome in self._each if _moved(odometry, outcome)])

    def with_live(self, maps: MapSet) -> MapSet:
        """Return the maps with the live map of all readings, if no drive moved and `max_readings` restricts EM."""
        return maps if self.moved else self.drives.with_live(maps)

    @property
    def texts(self) -> dict[str, str]:
        """Trajectories and calibrations of the drives that moved, as texts by file name."""
        found: dict[str, str] = {}
        for number, ((drive, odometry, outcome), estimates) in enumerate(
            zip(self._each, self.estimates, strict=True), 1
        ):
            several = len(self.outcomes) > 1
            found |= trajectory_files(outcome, odometry, number if several else None)
            if text := calibration_text(estimates, readable(drive.source['bag'])):
                found[f'odometry_calibration{f"_{number}" if several else ""}.yaml'] = text
        return found

    @property
    def _each(self) -> list[tuple[Drive, Odometry, Refinement]]:
        return list(zip(self.drives.drives, self.odometry, self.outcomes, strict=True))


class GivenCalibration(NamedTuple):
    """A calibration of odometry, with the names of `core.trajectory.odometry_model`, and its file."""

    calibration: Mapping[str, float]
    file: str


def refine_drives(
    drives: Drives,
    parameters: Parameters,
    watch: Watch = lambda stage, part: None,
    given: GivenCalibration | None = None,
    refine: bool = True,
) -> RefinedDrives:
    """Return the drives with their trajectories, and add these to the report's data.

    Each drive is refined separately, and begins at the first pose of its odometry. Then the drives that moved are
    registered, one after the other, to the map of the others.

    Parameters
    ----------
    drives : Drives
    parameters : Parameters
    watch : callable
        Receives the progress.
    given : GivenCalibration, optional
        A calibration to apply to the odometry of all drives first.
    refine : bool
        Whether to refine; otherwise odometry with its calibration is the trajectory.
    """
    several = len(drives.drives) > 1
    odometry = [odometry_of(drive) for drive in drives.drives]
    outcomes = []
    for drive, poses in zip(drives.drives, odometry, strict=True):
        name = f'{readable(drive.source["bag"])}, ' if several else ''
        outcomes.append(_outcome(drive, poses, parameters, partial(_named, watch, name), given, refine))
    estimates = []
    for drive, poses, outcome in zip(drives.drives, odometry, outcomes, strict=True):
        estimates.append(_estimates(drive, poses, outcome, parameters, watch, given))
    fitted = [''] * len(outcomes)
    if several and any(outcome.accepted for outcome in outcomes):
        watch('aligning the drives with each other', 0.0)
        outcomes, fitted = _fitted(outcomes, parameters)
    rows = zip(drives.drives, odometry, outcomes, fitted, estimates, strict=True)
    for number, (drive, poses, outcome, fits, known) in enumerate(rows, 1):
        # with several drives, the report has copies of their data
        source = drives.source['drives'][number - 1] if several else drive.source
        source['trajectory'] = trajectory_data(outcome, number if several else None, fits, known)
        source['trajectory']['calibrated'] = given.file if given and _moved(poses, outcome) else ''
        if outcome.unplaced:
            name = f'{readable(drive.source["bag"])}: ' if several else ''
            drives.source['warnings'].append(f'{name}{outcome.jumps}')
    return RefinedDrives(drives, tuple(odometry), tuple(outcomes), tuple(estimates))


def _estimates(
    drive: Drive,
    odometry: Odometry,
    outcome: Refinement,
    parameters: Parameters,
    watch: Watch,
    given: GivenCalibration | None,
) -> dict[str, CalibrationEstimate]:
    if not outcome.accepted or not outcome.calibration:
        return {}
    watch('calibration of odometry', 0.0)
    readings, trajectory, stop = drive.associator.readings, outcome.trajectory, np.zeros(1, np.uint8)
    if outcome.stretch is not None:
        # odometry beyond a jump does not contribute to the calibration
        begin, end = outcome.stretch
        readings = readings.select((readings.stamp >= begin) & (readings.stamp <= end))
        odometry, trajectory = odometry.between(begin, end), trajectory.between(begin, end)
    applied = odometry if given is None else _calibrated(odometry, given)
    if given is not None:
        readings = replaced(readings, odometry, applied)
    estimates = determined_calibration(readings, applied, trajectory, outcome.calibration, parameters, stop)
    if not outcome.right_angles:
        # without walls, the yaw follows odometry where readings contain little information, and would agree with it
        estimates = {name: each for name, each in estimates.items() if name not in YAW_ERRORS}
    return estimates if given is None else combined_calibration(given.calibration, estimates)


def _fitted(outcomes: list[Refinement], parameters: Parameters) -> tuple[list[Refinement], list[str]]:
    """Return the outcomes with moved drives registered to the others, and descriptions of these transforms.

    Drives with odometry as trajectory define the frame of the map, unless their heading was lost; without any, the
    first drive that moved does.
    """
    out, words = list(outcomes), [''] * len(outcomes)
    moved = [k for k, outcome in enumerate(outcomes) if outcome.accepted]
    placed = [k for k, outcome in enumerate(outcomes) if not outcome.accepted and not outcome.lost] or moved[:1]
    for k in moved:
        if k in placed:
            continue
        outcome = outcomes[k]
        others = of_drives([out[other].readings for other in placed])
        begin = outcome.trajectory.pose[0]
        found = register(outcome.readings, begin, others, parameters, np.zeros(1, np.uint8))
        if found.begin is not begin:
            trajectory = replace(outcome.trajectory, pose=moved_to(found.begin, outcome.trajectory.pose))
            there = readings_moved(outcome.readings, begin, found.begin)
            out[k] = replace(outcome, trajectory=trajectory, readings=there)
            x, y, yaw = relative(begin, found.begin).tolist()
            words[k] = (
                f'turned by {math.degrees(yaw):+.1f}° and moved by {math.hypot(x, y):.2f} m to align with the others'
            )
        placed.append(k)
    return out, words


def odometry_of(drive: Drive) -> Odometry:
    """Return the odometry of a drive: as recorded, or from the poses of its readings in a journal."""
    odometry = Odometry.of(*drive.associator.odometry)
    return odometry if drive.mounts is None else recovered(odometry, drive.associator.readings, drive.mounts)


def _outcome(
    drive: Drive, odometry: Odometry, parameters: Parameters, watch: Watch, given: GivenCalibration | None, refine: bool
) -> Refinement:
    readings = drive.associator.readings
    if drive.mounts is not None and not len(odometry.stamp):
        return Refinement(False, NO_MOUNTS, readings, odometry, {})
    if given is not None:
        if not _within(readings, odometry):
            return Refinement(False, NO_TIMES, readings, odometry, {})
        trajectory = _calibrated(odometry, given)
        readings, odometry = replaced(readings, odometry, trajectory), trajectory
    if not refine:
        return Refinement(False, '', readings, odometry, {})
    # it imports scipy, a quarter of the start time of `process_bag`, and most drives are mapped without it
    from ..core.trajectory.refinement import Refiner

    return Refiner(parameters).run(readings, odometry, watch)


def _calibrated(odometry: Odometry, given: GivenCalibration) -> Odometry:
    return calibrated(odometry, np.array([given.calibration.get(name, 0.0) for name in CALIBRATION]))


def _within(readings: Readings, odometry: Odometry) -> bool:
    return bool(
        len(odometry.stamp) and odometry.stamp[0] <= readings.stamp.min() <= readings.stamp.max() <= odometry.stamp[-1]
    )


def _moved(odometry: Odometry, outcome: Refinement) -> bool:
    return outcome.trajectory is not odometry


def _named(watch: Watch, name: str, stage: str, part: float) -> None:
    watch(name + stage, part)
