"""The report as text, which shows at a glance whether the run was good."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator
from datetime import datetime, timezone
from typing import Any

from ..core.common.words import counted, printable

UNTESTED = (
    'the drive may not determine these values; process_bag --refine-poses reports those that it determines, with their '
    'standard deviations'
)
"""Said of a calibration that was not tested: along a bare corridor, its values may have the wrong sign."""

_LABEL = 14
_WIDTH = 100
_SHOWN = 6
MUCH_RANDOM = 0.2
"""Random part of the echoes that is not reached with good poses."""


def report_text(data: dict[str, Any]) -> str:
    """Return the text of a report from `report_data`; absent values are left out."""
    sections = (_warnings, _input, _trajectory, _counts, _drives, _sensors, _map, _result, _seconds, _parameters)
    title = f'Sonar maps by forward_grid_mapper {data.get("version") or ""}'.rstrip()
    parts = [f'{title}\n{"=" * len(title)}']
    for section in sections:
        if lines := list(section(data)):
            parts.append('\n'.join(lines))
    return printable('\n\n'.join(parts)) + '\n'


def _warnings(data: dict[str, Any]) -> Iterator[str]:
    warnings = data.get('warnings') or []
    if warnings:
        yield f'WARNINGS ({len(warnings)})'
    for warning in warnings:
        yield textwrap.fill(str(warning), _WIDTH, initial_indent='  ! ', subsequent_indent='    ')


def _input(data: dict[str, Any]) -> Iterator[str]:
    source = data.get('input') or {}
    if bag := source.get('bag'):
        yield from _line('Bag', bag)
    if topics := source.get('range_topics'):
        yield from _line('Ranges from', topics if isinstance(topics, str) else ', '.join(map(str, topics)))
    if topic := source.get('odom_topic'):
        frame = source.get('odom_frame')
        yield from _line('Odometry', f'{topic}, frame {frame}' if frame else topic)
    if frame := source.get('map_frame'):
        yield from _line('Map frame', frame)
    if extrinsics := source.get('mounts_from'):
        yield from _line('Sensor poses', f'from {extrinsics}')
    drive = []
    if (path := source.get('path_m')) is not None:
        drive.append(f'{path:.1f} m')
    if (duration := source.get('duration_s')) is not None:
        drive.append(f'in {duration:.1f} s')
    if start := _date(source.get('stamps')):
        drive.append(f'from {start}')
    if drive:
        yield from _line('Drive', ' '.join(drive))


def _trajectory(data: dict[str, Any]) -> Iterator[str]:
    drives = [found for drive in data.get('drives') or [] if (found := drive.get('trajectory'))]
    if drives:
        moved = sum(bool(found.get('refined')) for found in drives)
        yield from _line('Trajectory', f'{moved} of {len(drives)} refined, see the drives')
        return
    found = (data.get('input') or {}).get('trajectory')
    if not found:
        return
    yield from _line('Trajectory', _description(found))
    if words := _wheels(found):
        yield from _line('Wheels', words)


def _description(found: dict[str, Any]) -> str:
    """Return a description of a trajectory."""
    calibrated = f', with the calibration of {found["calibrated"]}' if found.get('calibrated') else ''
    if not found.get('refined'):
        reason = f', not refined: {found.get("reason")}' if found.get('reason') else ''
        return f"odometry's{calibrated}{reason}"
    places = found.get('places_recognised') or 0
    return (
        f'refined: odometry{calibrated} was off by {found["odometry_off_m"]:.2f} m and '
        f'{found["odometry_off_deg"]:.1f}° (root mean square, both paths aligned); {places} '
        f'{"place" if places == 1 else "places"} recognised; '
        + '; '.join(filter(None, [found['reason'], found.get('fitted')]))
    )


def _wheels(found: dict[str, Any]) -> str:
    words = found.get('odometry') or ''
    if not words or found.get('calibration_estimates') == {}:
        return words
    check = 'these values are for this drive: measure a straight line and a full turn before you set them'
    return f'{words}; {UNTESTED if found.get("calibration_estimates") is None else check}'


def _counts(data: dict[str, Any]) -> Iterator[str]:
    counts = data.get('counts') or {}
    accepted, rejected = counts.get('accepted') or 0, counts.get('rejected') or {}
    received = counts.get('received')
    if received is None:
        received = accepted + sum(rejected.values())
    waiting = f', {counts["waiting"]:,} waiting' if counts.get('waiting') else ''
    yield from _line(
        'Readings', f'{received:,} received, {accepted:,} accepted ({_share(accepted, received)}){waiting}'
    )
    if counts.get('lost') is not None:
        yield from _line('Lost', f'{counts["lost"]:,} before they were received (estimated)')
    if rejected:
        yield '  rejected'
    by_frame = (data.get('input') or {}).get('rejected_by_frame') or {}
    for reason, number in sorted(rejected.items(), key=lambda item: -item[1]):
        lead = f'  {number:>12,}  {_share(number, received):>7}  {reason}'
        yield f'{lead}{_frames({name: n for name, row in by_frame.items() if (n := row.get(reason))})}'


def _frames(counts: dict[str, int]) -> str:
    """Return the frames with most readings, and their numbers; sensors with the same fault may be many."""
    if not counts:
        return ''
    order = sorted(counts, key=lambda name: (-counts[name], name))
    more = f', {len(order) - _SHOWN} more' if len(order) > _SHOWN else ''
    return f' ({", ".join(f"{name} {counts[name]:,}" for name in order[:_SHOWN])}{more})'


def _drives(data: dict[str, Any]) -> Iterator[str]:
    drives = data.get('drives') or []
    if not drives:
        return
    yield f'{"Drives":<12}{"received":>12}{"accepted":>12}{"used":>12}{"random":>9}{"path":>10}{"time":>10}'
    for drive in drives:
        counts, sensors = drive.get('counts') or {}, drive.get('sensors') or {}
        used = sum(row['accepted'] for row in sensors.values())
        yield from textwrap.wrap(f'  {drive.get("bag")}', _WIDTH, subsequent_indent='    ', break_on_hyphens=False)
        cells = f'{_number(counts.get("received")):>12}{_number(counts.get("accepted")):>12}{used:>12,}'
        length, duration = drive.get('path_m') or 0.0, drive.get('duration_s') or 0.0
        yield f'{"":<12}{cells}{_share(drive.get("unexplained"), used):>9}{length:>8.1f} m{duration:>8.1f} s'
        lines = [_each(sensors)]
        if found := drive.get('trajectory'):
            file = found.get('file')
            lines.append(f'trajectory {_description(found)}' + (f' ({file})' if file else ''))
            lines += [f'wheels: {words}' for words in [_wheels(found)] if words]
        for text in lines:
            yield from textwrap.wrap(
                text, _WIDTH, initial_indent='    ', subsequent_indent='    ', break_on_hyphens=False
            )


def _each(sensors: dict[str, Any]) -> str:
    """Return the number of readings used of each sensor."""
    counts = {name: row['accepted'] for name, row in sorted(sensors.items())}
    least, most = min(counts.values(), default=0), max(counts.values(), default=0)
    if least == most and len(counts) > 1:
        return f'{len(counts)} sensors, {most:,} of each'
    return ', '.join(f'{name} {count:,}' for name, count in counts.items())


def _sensors(data: dict[str, Any]) -> Iterator[str]:
    sensors = data.get('sensors') or {}
    if not sensors:
        return
    width = max(12, *(len(name) + 2 for name in sensors))
    counted_in = sum(row.get('accepted') or 0 for row in sensors.values())
    # `max_readings` leaves out some of the accepted ones
    all_used = counted_in >= ((data.get('counts') or {}).get('accepted') or 0)
    heads = ('accepted' if all_used else 'used', 'max range', 'random', 'short')
    yield f'{"Sensors":<{width}}{"".join(f"{head:>10}" for head in heads)}  verdict'
    for name, row in sorted(sensors.items()):
        total, health = row.get('accepted'), row.get('health') or {}
        shares = [_share(row.get(key), total) for key in ('no_echo', 'unexplained')]
        # without readings there is no fraction
        shares.append(_share(health.get('short'), 1))
        cells = ''.join(f'{cell:>10}' for cell in (_number(total), *shares))
        yield f'  {name:<{width - 2}}{cells}  {health.get("verdict", "")}'.rstrip()


def _map(data: dict[str, Any]) -> Iterator[str]:
    grid = data.get('map') or {}
    if not grid.get('resolution'):
        return
    cell, (x, y) = grid['resolution'], grid['origin']
    size = f'{grid["width"] * cell:.1f} x {grid["height"] * cell:.1f} m'
    yield from _line(
        'Map', f'{size}: {grid["width"]} x {grid["height"]} cells of {cell:g} m, corner ({x:.2f}, {y:.2f})'
    )
    cells = (f'{_number(grid.get(f"{kind}_cells"))} {word}' for kind, word in _KINDS)
    yield from _line('Cells', f'{", ".join(cells)} in the maximum likelihood map')


_KINDS = (('occupied', 'occupied'), ('free', 'free'), ('unknown', 'not observed'))


def _result(data: dict[str, Any]) -> Iterator[str]:
    result, statistics = data.get('result') or {}, data.get('statistics') or {}
    readings, likelihood = result.get('readings'), result.get('log_likelihood')
    if likelihood is not None:
        mean = f' ({likelihood / readings:.3f} a reading)' if readings else ''
        yield from _line('Log-likelihood', f'{likelihood:,.1f} nats{mean}')
    if (objective := result.get('objective')) is not None:
        searched = statistics.get('searched_objective')
        before = '' if searched is None else f'; {searched:,.1f} nats at the end of the search, before post-processing'
        yield from _line('Objective', f'{objective:,.1f} nats{before}')
    if (unexplained := result.get('unexplained')) is not None:
        share = _share(unexplained, readings)
        are = 'is most likely a random measurement' if unexplained == 1 else 'are most likely random measurements'
        paths = [source.get('trajectory') or {} for source in (data.get('input') or {}, *(data.get('drives') or []))]
        sought = any(path.get('refined') or path.get('reason') for path in paths)
        rows = (data.get('sensors') or {}).values()
        silent = sum(row.get('no_echo') or 0 for row in rows)
        # readings without an echo are hardly ever random measurements, and some sensors have few echoes
        many = unexplained > MUCH_RANDOM * ((readings or math.inf) - silent) and not sought
        option = '--refine-poses' if (data.get('input') or {}).get('bag') else 'refine_poses'
        causes = f'odometry that drifts ({option}), wrong poses of sensors, or people who walk by'
        hint = f': many, as with {causes}' if many else ''
        yield from _line('Random', f'{counted(unexplained, "reading", ",")} ({share}) {are}{hint}')
    work = [f'{statistics[key]:,} {key}' for key in ('pairs', 'iterations', 'flips', 'shifts') if statistics.get(key)]
    if (converged := statistics.get('converged')) is not None:
        work.append('converged' if converged else 'NOT converged: max_iterations was reached')
    if work:
        yield from _line('Search', ', '.join(work))
    if tiles := statistics.get('tiles'):
        yield from _line(
            'Tiles',
            f'{tiles:,}, searched {counted(statistics["searches_of_tiles"], "time", ",")}; a reading belongs to '
            f'{statistics["evaluations_of_a_reading"]:.2f} of them',
        )


def _seconds(data: dict[str, Any]) -> Iterator[str]:
    seconds = data.get('seconds')
    if isinstance(seconds, (int, float)):
        yield from _line('Seconds', f'{seconds:.2f}')
    elif seconds:
        stages = {name: s for name, s in seconds.items() if isinstance(s, (int, float))}
        text = ', '.join(f'{name} {s:.2f}' for name, s in stages.items())
        yield from _line('Seconds', text if 'total' in stages else f'{text}; together {sum(stages.values()):.2f}')


def _parameters(data: dict[str, Any]) -> Iterator[str]:
    changed = data.get('changed_parameters')
    if changed is None:
        return
    if not changed:
        yield from _line('Parameters', 'all at their defaults')
        return
    yield 'Parameters that differ from the defaults'
    width = max(map(len, changed))
    for name, row in changed.items():
        value = f'{row["value"]:.6g}' if isinstance(row['value'], float) else row['value']
        default = 'empty' if row['default'] == '' else row['default']
        yield f'  {name:<{width}}  {value}  (default {default})'


def _line(label: str, text: object) -> Iterator[str]:
    lead = f'{label:<{_LABEL}}  '
    options: dict[str, Any] = {'break_long_words': False, 'break_on_hyphens': False}
    yield textwrap.fill(str(text), _WIDTH, initial_indent=lead, subsequent_indent=' ' * len(lead), **options)


def _number(value: Any) -> str:
    return '–' if value is None else f'{value:,}'


def _share(part: Any, whole: Any) -> str:
    return '–' if part is None or not whole else f'{100.0 * part / whole:.1f} %'


def _date(stamps: Any) -> str:
    """Return the first stamp as a date; '' for simulated time, which starts at zero."""
    first = stamps[0] if isinstance(stamps, list) and stamps else stamps
    if not isinstance(first, int) or first < 10**17:
        return ''
    return datetime.fromtimestamp(first // 10**9, timezone.utc).strftime('%Y-%m-%d %H:%M:%S UTC')
