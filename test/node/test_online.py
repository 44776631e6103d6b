"""The online map of the node, over DDS."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the tests of the node need rclpy')

from robot import Robot
from test_mapper_node import RELIABLE, extrinsics, merged, values

from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.core.common.parameters import Parameters
from forward_grid_mapper.core.mapping import Mapper
from forward_grid_mapper.simulation.drive import door_drive
from forward_grid_mapper.simulation.score import score_map, visible_surface
from forward_grid_mapper.simulation.sonar import NOISY


def test_online_maps_follow_the_readings_and_em_improves_them(start: Any, robot: Robot, tmp_path: Path) -> None:
    door = door_drive(16, NOISY, seed=3)
    options = ('-p', 'online:=true', '-p', 'publish_rate:=10.0', '-p', f'save_directory:={tmp_path}')
    start(*RELIABLE, *extrinsics(door), *options)
    robot.meet()
    robot.listen()
    messages = merged(door)
    robot.play(messages[: len(messages) // 2])
    robot.until(lambda: robot.maps['ml_map'], what='a maximum likelihood map without any call')
    robot.play(messages[len(messages) // 2 :])
    batch = Mapper(Parameters()).run(door.readings)

    def whole_drive() -> Any:
        last = robot.maps['ml_map'][-1]
        # the last readings may wait for a pose
        return last if last.info.width >= batch.grid.width - 10 else None

    robot.until(whole_drive, what='a map of the whole drive')
    robot.spin(1.0)
    whole = robot.maps['ml_map'][-1]
    assert robot.maps['uncertainty_map'][-1].info.width == whole.info.width
    visible = visible_surface(door.world, door.readings, 0.2)

    def f1(message: Any) -> float:
        info = message.info
        column, row = (round(at / info.resolution) for at in (info.origin.position.x, info.origin.position.y))
        grid = Grid(info.resolution, column, row, info.width, info.height)
        ml = np.where(values(message) == 100, 1, values(message)).astype(np.int8)
        return score_map(ml, grid, door.world, visible).f1

    assert f1(whole) == pytest.approx(score_map(batch.ml, batch.grid, door.world, visible).f1, abs=0.03)
    answer = robot.call('run_em')
    assert answer.success, answer.message
    found = re.search(r'objective (-?[\d.]+)', answer.message)
    assert found
    # from the online map, the search may end at another optimum, with about the same objective
    assert float(found.group(1)) > batch.objective - 0.02 * abs(batch.objective)
    improved = robot.until(lambda: robot.maps['ml_map'][-1], what='the map of EM')
    assert f1(improved) > 0.9

    robot.call('reset')
    robot.spin(0.5)
    assert np.all(values(robot.maps['ml_map'][-1]) == -1)


def test_parameters_can_change_at_run_time(start: Any, robot: Robot) -> None:
    door = door_drive(1, NOISY, seed=1)
    node = start(*RELIABLE, *extrinsics(door), '-p', 'online:=true', '-p', 'publish_rate:=10.0')
    robot.meet()
    robot.listen()
    robot.play(merged(door))
    robot.until(lambda: robot.maps['ml_map'], what='a maximum likelihood map')
    robot.spin(1.0)
    seen = len(robot.maps['ml_map'])
    assert robot.set_parameter('p_hit', 0.5).successful
    robot.until(lambda: len(robot.maps['ml_map']) > seen, what='a map by the new parameters')
    assert 'Error' not in node.output
