"""The service save_maps: files, names and warnings; each call gets a response, also after errors."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='the service is one of rclpy')

from stand_ins import PlainNode

from forward_grid_mapper.core.common.errors import OutputError
from forward_grid_mapper.core.common.grid import Grid
from forward_grid_mapper.files.output_folder import TakenError, output_folder
from forward_grid_mapper.node import saver
from forward_grid_mapper.node.em import Outcome
from forward_grid_mapper.node.live import LiveSnapshot
from forward_grid_mapper.node.refining import FoundTrajectory
from forward_grid_mapper.node.saver import Account, Saver

GRID = Grid(0.1, 0, 0, 3, 2)
LIVE = np.full(GRID.shape, 0.5, np.float32)
ODOMETRY = np.arange(3), np.zeros((3, 3))


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


class Reply:
    """A response that may come from another thread."""

    def __init__(self) -> None:
        self.sent: list[tuple[bool, str]] = []
        self.came = threading.Event()

    def send(self, success: bool, message: str) -> None:
        self.sent.append((success, message))
        self.came.set()

    def answer(self) -> tuple[bool, str]:
        assert self.came.wait(60.0)
        (found,) = self.sent
        return found


class Node:
    """Stand-in for the node; `written` has the arguments of `write_results`."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.log = PlainNode()
        self.written: list[tuple[Any, ...]] = []
        self.generation, self.waiting, self.accepted = 4, list[Callable[[Outcome], object]](), 10
        self.em: Any = SimpleNamespace(maps=None, current=None, accepted_at_run=10, found_trajectory=None)
        self.em.when_there_are_maps = self.waiting.append
        self.live: Any = SimpleNamespace(
            generation=4, snapshot=lambda: LiveSnapshot(self.generation, GRID, LIVE), worker=None
        )
        self.folder, self.source = folder, {'node': '/mapper', 'warnings': ['from the node']}
        self.maps: Any = SimpleNamespace(
            readings=range(10),
            with_live=lambda grid, probability: SimpleNamespace(readings=range(10), live=(grid, probability)),
        )
        self.before_agreeing = self.after_agreeing = lambda: None
        self.saver = Saver(self.em, self.live, self.account, self.log)
        monkeypatch.setattr(saver, 'write_results', self.write)

    def account(self) -> Account:
        source = {**self.source, 'warnings': [*self.source['warnings']]}
        return Account(source, self.accepted, [(0.0, 1.0), (2.0, 3.0)], ODOMETRY, str(self.folder), 'Maps of me')

    def write(self, folder: Path, *arguments: Any, agree: Callable[[], None], **options: Any) -> dict[str, Any]:
        self.before_agreeing()
        agree()
        self.after_agreeing()
        folder.mkdir(parents=True)
        for name in ('maps.npz', 'report.txt', 'b.pgm', 'report.html', 'ml_map.yaml'):
            (folder / name).touch()
        self.written.append((folder, *arguments, options))
        return {'warnings': arguments[1]['warnings']}

    def save(self, outcome: Outcome | None = None) -> Reply:
        """Call the service, and end EM with this outcome."""
        reply = Reply()
        self.saver.save_maps(reply)  # type: ignore[arg-type]
        self.waiting.pop()(outcome or Outcome(self.maps, ''))
        return reply


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Node:
    return Node(tmp_path / 'saved', monkeypatch)


def test_response_names_the_main_files(node: Node) -> None:
    success, message = node.save().answer()
    ((folder, maps, source, path_xy, title, options),) = node.written
    assert success and message == (
        f'{folder}/ml_map.yaml for Nav2, {folder}/report.html for a browser, {folder}/report.txt, and 2 files more; '
        'WARNINGS (1): see report.txt'
    )
    assert folder.parent == node.folder.resolve() and folder.name.startswith('maps_2')
    assert maps.live == (GRID, LIVE)
    assert source['warnings'] == ['from the node'] and 'trajectory' not in source
    assert path_xy.tolist() == [[0.0, 1.0], [2.0, 3.0]] and title == 'Maps of me' and options == {}
    assert node.log.warned == ['save_maps: from the node']


def test_each_call_uses_a_free_name(node: Node) -> None:
    for _ in range(3):
        assert node.save().answer()[0]
    assert len({folder for folder, *_ in node.written}) == 3


@pytest.mark.parametrize('how', ['it is being written', 'at the same moment', 'it was made meanwhile'])
def test_nodes_that_save_in_the_same_second_use_different_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr(time, 'strftime', lambda format: '2026-01-02_03-04-05')
    tried: list[str] = []

    def save(path: Path) -> dict[str, Any]:
        tried.append(path.name)
        if how == 'at the same moment' and len(tried) == 1:
            other.enter_context(output_folder(path))
        with output_folder(path) as folder:
            (folder / 'mine').touch()
            if how == 'it was made meanwhile' and len(tried) == 1:
                (path / 'of another node').mkdir(parents=True)
        return {}

    with ExitStack() as other:
        if how == 'it is being written':
            other.enter_context(output_folder(tmp_path / 'maps_2026-01-02_03-04-05'))
        found, _ = saver.in_a_free_folder(tmp_path, save)
        assert found == tmp_path / 'maps_2026-01-02_03-04-05_2'
        assert [path.name for path in found.iterdir()] == ['mine']
    assert len(tried) == (1 if how == 'it is being written' else 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == [found.name[:-2], found.name]


def test_names_that_are_always_taken_end_with_an_error(tmp_path: Path) -> None:
    def save(path: Path) -> dict[str, Any]:
        raise TakenError('taken')

    with pytest.raises(OutputError, match='taken'):
        saver.in_a_free_folder(tmp_path, save)


def test_rests_of_killed_nodes_are_removed_and_nothing_else(node: Node) -> None:
    node.folder.mkdir()
    rests = ['.maps_2026-01-02_03-04-05.0123abcd.partial', '.maps_2026-01-02_03-04-05_2.0123abcd.partial']
    kept = [
        *('maps_2026-01-02_03-04-05', '.maps_2026-01-02_03-04-05', '.maps_mine.0123abcd.partial'),
        *('.maps_2026-01-02_03-04-05.0123abcd', 'maps_2026-01-02_03-04-05.0123abcd.partial', '.other.0123abcd.partial'),
    ]
    for name in rests + kept:
        (node.folder / name).mkdir()
        (node.folder / name / 'maps.npz').touch()
    (node.folder / '.maps_2026-01-02_03-04-06.0123abcd.partial').touch()
    link = node.folder / '.maps_2026-01-02_03-04-07.0123abcd.partial'
    link.symlink_to(node.folder / kept[0])
    with output_folder(node.folder / 'maps_2026-01-02_03-04-08') as writing:
        assert node.save().answer()[0]
        ((saved, *_),) = node.written
        left = {path.name for path in node.folder.iterdir()}
    assert left == {*kept, writing.name, link.name, '.maps_2026-01-02_03-04-06.0123abcd.partial', saved.name}
    assert all((node.folder / name / 'maps.npz').exists() for name in kept)


def test_path_of_a_robot_without_poses_is_empty(node: Node) -> None:
    account = node.account()._replace(path=[])
    node.saver._account = lambda: account
    assert node.save().answer()[0]
    assert node.written[0][3].shape == (0, 2)


@pytest.mark.parametrize(
    ('newer', 'expected', 'them'),
    [(0, '', ''), (1, '1 reading arrived after EM', 'it'), (7, '7 readings arrived after EM', 'them')],
)
def test_readings_received_after_em_give_a_warning(node: Node, newer: int, expected: str, them: str) -> None:
    node.accepted += newer
    node.source['warnings'].clear()
    message = node.save().answer()[1]
    warnings = node.written[0][2]['warnings']
    assert len(warnings) == bool(expected) and 'WARNINGS' not in message
    assert ('arrived after EM' in message) == bool(expected)
    if expected:
        assert message.endswith(f'; {expected}')
        assert warnings[0].startswith(f'{expected}: only the live map contains {them};')


def test_thinned_readings_give_a_warning(node: Node) -> None:
    node.em.accepted_at_run = node.accepted = 25
    node.save().answer()
    assert 'EM used 10 of 25 readings' in node.written[0][2]['warnings'][1]


def test_waiting_for_em_is_logged(node: Node) -> None:
    node.save().answer()
    assert not any('waits' in text for text in node.log.warned)
    node.em.current = object()
    node.save().answer()
    assert 'save_maps waits for the end of EM' in node.log.warned
    node.log.warned.clear()
    node.em.maps = node.maps
    node.save().answer()
    assert not any('waits' in text for text in node.log.warned)


def test_save_without_maps_fails_with_reason(node: Node) -> None:
    assert node.save(Outcome(None, 'EM was cancelled')).answer() == (
        False,
        'there is no map to save: EM was cancelled',
    )
    assert node.written == [] and node.saver.worker.waiting == 0


def test_maps_from_before_a_reset_are_not_written(node: Node) -> None:
    node.generation = 5
    success, message = node.save().answer()
    assert not success and 'reset deleted them' in message
    assert node.written == []


@pytest.mark.parametrize(
    ('error', 'message', 'trouble'),
    [
        (OutputError('the disk is full'), 'the disk is full', ''),
        (MemoryError(), 'save_maps failed: there is not enough memory', 'there is not enough memory'),
        (KeyError('odd'), "save_maps failed: KeyError('odd')", "KeyError('odd')"),
    ],
)
def test_error_of_writing_is_the_response(
    node: Node, monkeypatch: pytest.MonkeyPatch, error: Exception, message: str, trouble: str
) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(saver, 'write_results', fail)
        assert node.save().answer() == (False, message)
    until(lambda: not node.saver.worker.waiting)
    assert node.saver.worker.trouble == trouble
    assert node.save().answer()[0]


def test_save_that_a_clean_up_cuts_leaves_no_folder(node: Node) -> None:
    """The node answers the call with a failure."""
    closed = threading.Event()
    node.before_agreeing = lambda: closed.wait(60.0)
    reply = node.save()
    until(lambda: node.saver.worker._busy)
    node.saver.close(0.0)
    closed.set()
    success, message = reply.answer()
    assert not success and 'the node is being cleaned up' in message
    assert not node.written and not node.folder.exists()


def test_clean_up_waits_while_a_folder_gets_its_name(node: Node) -> None:
    named, go, closed = threading.Event(), threading.Event(), list[int]()

    def hold() -> None:
        named.set()
        assert go.wait(60.0)

    def close() -> None:
        node.saver.close(0.0)
        closed.append(len(reply.sent))

    node.after_agreeing = hold
    reply = node.save()
    assert named.wait(60.0)
    thread = threading.Thread(target=close)
    thread.start()
    until(lambda: node.saver.worker._closed)
    go.set()
    thread.join(60.0)
    assert reply.answer()[0] and closed == [1], 'answered before the node says that it is being cleaned up'


def trajectory(moved: bool, unplaced: int = 0) -> FoundTrajectory:
    correction = SimpleNamespace(odometry='odometry', path_of=lambda stamp, pose: ('path of', stamp, pose))
    refinement = SimpleNamespace(unplaced=unplaced, jumps='odometry jumped')
    found: Any = FoundTrajectory(refinement, correction if moved else None, None)  # type: ignore[arg-type]
    return found  # type: ignore[no-any-return]


def test_trajectory_is_written_with_the_maps(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(saver, 'trajectory_data', lambda refinement: {'jumps': refinement.jumps})
    monkeypatch.setattr(saver, 'trajectory_files', lambda refinement, odometry: {'trajectory.tum': odometry})
    node.em.found_trajectory = trajectory(moved=True)
    node.save().answer()
    _, _, source, path_xy, _, options = node.written[-1]
    assert source['trajectory'] == {'jumps': 'odometry jumped'}
    assert path_xy == ('path of', *ODOMETRY)
    assert options['extras'] == {'trajectory.tum': 'odometry'}
    assert options['odometry_xy'].tolist() == [[0.0, 1.0], [2.0, 3.0]]
    assert source['warnings'] == ['from the node']
    # if odometry is kept, the path is that of odometry; if a part could not be placed, there is a warning
    node.em.found_trajectory = trajectory(moved=False, unplaced=3)
    node.save().answer()
    _, _, source, path_xy, _, options = node.written[-1]
    assert source['trajectory'] and path_xy.shape == (2, 2) and options == {}
    assert source['warnings'] == ['from the node', 'odometry jumped']
    node.em.found_trajectory = FoundTrajectory(None, None, None)
    node.save().answer()
    assert 'trajectory' not in node.written[-1][2]
