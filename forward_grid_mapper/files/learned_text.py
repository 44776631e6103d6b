"""The result of learning, as text and as a parameter file."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from ..core.common.errors import OutputError
from ..core.joint_learning import Learned
from ..core.learning.standard_errors import LEARNED
from ..core.messages.message_types import Pose2
from .output_folder import output_errors
from .parameter_text import dump_parameters

_WIDTH = 100

_HOW = (
    'Standard errors: observed information of the readings given the map, and the scatter of 30 blocks of time where '
    'that is larger; 95 % intervals. Both are conditional on the map: they do not include that the map was made from '
    'the same readings. Such a map fits its readings too well: p_rand and sigma are too low or, with a prior that '
    'makes occupied cells expensive, p_hit is too high, by many standard errors.'
)


def learned_text(learned: Learned) -> str:
    """Return warnings, the learned values and the rounds as lines of text."""
    parts = [_warnings(learned), _values(learned), _rounds(learned)]
    return '\n\n'.join('\n'.join(lines) for part in parts if (lines := list(part))) + '\n'


def learned_data(learned: Learned) -> dict[str, Any]:
    """Return the same for programs: values with their standard errors, rounds, and warnings."""
    start, model = learned.rounds[0].model, learned.parameters.model
    values = {}
    for name in LEARNED:
        estimate = learned.estimates.get(name)
        sure = {} if estimate is None else {k: getattr(estimate, k) for k in ('error', 'low', 'high', 'readings')}
        values[name] = {'start': getattr(start, name), 'learned': getattr(model, name), **sure}
    rounds = [
        {
            **{name: getattr(r.model, name) for name in LEARNED},
            'log_likelihood': r.log_likelihood,
            'occupied': r.occupied,
            'unexplained': r.unexplained,
            'lost_m': r.lost_length,
        }
        for r in learned.rounds
    ]
    return {
        'warnings': list(learned.warnings),
        'values': values,
        'rounds': rounds,
        'accepted_round': learned.accepted,
        'converged': learned.converged,
        'cross_validation': learned.cross_validation and learned.cross_validation._asdict(),
        'parameters': learned.parameters.flat(),
    }


def _warnings(learned: Learned) -> Iterator[str]:
    if learned.warnings:
        yield f'WARNINGS ({len(learned.warnings)})'
    for warning in learned.warnings:
        yield textwrap.fill(warning, _WIDTH, initial_indent='  ! ', subsequent_indent='    ')


def _values(learned: Learned) -> Iterator[str]:
    start, model = learned.rounds[0].model, learned.parameters.model
    yield f'{"Parameter":<12}{"start":>9}{"learned":>9}{"std error":>11}{"95 % interval":>19}{"informed by":>20}'
    for name in LEARNED:
        row = f'  {name:<10}{getattr(start, name):9.4f}{getattr(model, name):9.4f}'
        estimate = learned.estimates.get(name)
        if estimate is None:
            yield f'{row}{"–":>11}{"not learned":>19}'
            continue
        known = math.isfinite(estimate.error)
        error = f'{estimate.error:.4f}' if known else '–'
        interval = f'{estimate.low:.4f} … {estimate.high:.4f}' if known else '–'
        yield f'{row}{error:>11}{interval:>19}{estimate.readings:>11,.0f} readings'
    if seen := learned.cross_validation:
        at_first, at_learned = seen.gains
        yield (
            f'  Gain of the map of the learned values, nats a held-out reading: {at_first:+.3f} ± '
            f'{seen.error_at_first:.3f} by'
        )
        yield f'  the initial model, {at_learned:+.3f} ± {seen.error_at_learned:.3f} by the learned one'
    yield textwrap.fill(_HOW, _WIDTH, initial_indent='  ', subsequent_indent='  ')


def _rounds(learned: Learned) -> Iterator[str]:
    yield (
        f'{"Round":<7}{"p_hit":>8}{"p_rand":>8}{"p_lost":>8}{"sigma":>8}{"log-likelihood":>16}{"old map":>11}'
        f'{"occupied":>10}{"random":>11}{"lost wall":>11}'
    )
    for number, r in enumerate(learned.rounds):
        m = r.model
        before = f'{r.log_likelihood_before:.1f}' if math.isfinite(r.log_likelihood_before) else '–'
        verdict = ' kept' if number == learned.accepted else ' refused' if number > learned.accepted else ''
        yield (
            f'  {number:<5}{m.p_hit:8.4f}{m.p_rand:8.4f}{m.p_lost:8.4f}{m.sigma:8.4f}{r.log_likelihood:16.1f}'
            f'{before:>11}{r.occupied:10,}{r.unexplained:11,}{r.lost_length:9.1f} m{verdict}'
        )


def parameter_file_text(
    learned: Learned, extrinsics: Mapping[str, Pose2], ros: Mapping[str, Any], source: str = ''
) -> str:
    """Return a ROS 2 parameter file with the learned values and the given sensor poses.

    Parameters
    ----------
    learned : Learned
    extrinsics : mapping of str to Pose2
        Poses of sensors, to be written into the file.
    ros : mapping
        Parameters that ROS itself declares for every node.
    source : str
        The recordings that were used, for a comment.
    """
    where = f' from {" ".join(source.split())}' if source else ''
    if learned.accepted:
        lines = [f'# Learned{where}, together with the map:']
    else:
        lines = [f'# Nothing was learned{where}; these are the initial values:']
    for name in LEARNED:
        estimate = learned.estimates.get(name)
        value = getattr(learned.parameters.model, name)
        sure = f' ± {estimate.error:.2g}' if estimate and math.isfinite(estimate.error) else ', no standard error'
        lines.append(f'#   {name} {value:.4g}{sure}')
    lines += [f'# WARNING: {line}' for line in learned.warnings]
    text = '\n'.join(lines) + '\n' + dump_parameters(learned.parameters)
    extra = {f'sensors.{frame}.pose': [float(v) for v in pose] for frame, pose in extrinsics.items()} | dict(ros)
    for key, value in extra.items():
        # lists on one line, as elsewhere in the file
        flow = None if isinstance(value, list) else False
        # yaml would put the value of a long name on its own line
        made = yaml.safe_dump({key: value}, default_flow_style=flow, width=1000).strip().splitlines()
        text += ''.join(f'    {line}\n' for line in made)
    return text


def write_new_file(path: Path, text: str) -> None:
    """Write a file that must not exist yet; if this fails, no file remains.

    Raises
    ------
    OutputError
        If it exists, or cannot be written.
    """
    with output_errors(path):
        try:
            file = path.open('x', encoding='utf-8')
        except FileExistsError as error:
            raise OutputError(f'{path} exists; choose another file with --output, or remove it first') from error
        try:
            with file:
                file.write(text)
        except BaseException:
            # after Ctrl-C as well as on a full disk
            path.unlink(missing_ok=True)
            raise
