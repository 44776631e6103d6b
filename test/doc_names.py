"""The names on the pages of the documentation, and whether they exist.

Sources are parsed and not imported, so that pages about the node are checked without ROS.
"""

from __future__ import annotations

import ast
import importlib
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from forward_grid_mapper.__main__ import COMMANDS
from forward_grid_mapper.core.common import former_parameters
from forward_grid_mapper.core.common import parameters as table
from forward_grid_mapper.core.messages.rep117 import ODOMETRY_REASONS, REASONS
from forward_grid_mapper.files.parameter_file import NODE_NAME

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'forward_grid_mapper'
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').glob('*.md'))]

FOLDERS = (ROOT, PACKAGE, PACKAGE / 'core', ROOT / 'test')
"""Folders where a path on a page may begin, in addition to the folder of the page."""

SHOWN = r'(?:benchmarks|config|docs|launch|rviz|scripts|test|core|files|bags|node|commands|\.ci)/[\w./-]*\w'
"""A path inside the repository, in a command line or in prose."""

SETTABLE = {row.name for row in table.TABLE}

PARAMETERS = {row.name: row for row in (*table.TABLE, *table.CONSTANTS)}
"""Parameters, and constants that a page may name."""

DEPRECATED = {*former_parameters.DEPRECATED, *former_parameters.RENAMED} - {*PARAMETERS}
"""Former names of parameters; a page must mark them as former."""

SAYS_SO = re.compile(r'deprecated|former|was called|old name|until the next version', re.IGNORECASE)

NUMBER = r'-?\d+(?:\.\d+)?(?:e-?\d+)?'


# Existing names


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding='utf-8'))


@cache
def sources() -> dict[str, list[Path]]:
    """Python files by name, without folder."""
    found = defaultdict(list)
    for folder in (PACKAGE, ROOT / 'test', ROOT / 'benchmarks', ROOT / 'launch'):
        for path in sorted(folder.rglob('*.py')):
            found[path.name].append(path)
    return dict(found)


def _targets(node: ast.AST) -> Iterator[str]:
    """Names bound by a statement: plain names and attributes of `self`."""
    for target in getattr(node, 'targets', [getattr(node, 'target', None)]):
        for part in ast.walk(target) if target is not None else ():
            if isinstance(part, ast.Name):
                yield part.id
            elif isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name) and part.value.id == 'self':
                yield part.attr


@cache
def names_in(path: Path) -> frozenset[str]:
    """The definitions of a file: functions, classes, constants, and members as `Class.member`."""
    found = set()
    for node in tree_of(path).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        if isinstance(node, (ast.Assign, ast.AnnAssign)):
            found |= set(_targets(node))
        if isinstance(node, ast.ClassDef):
            for part in ast.walk(node):
                if isinstance(part, ast.FunctionDef):
                    found.add(f'{node.name}.{part.name}')
                if isinstance(part, (ast.Assign, ast.AnnAssign)):
                    found |= {f'{node.name}.{name}' for name in _targets(part)}
    return frozenset(found)


@cache
def texts_in(*folders: str) -> frozenset[str]:
    """String constants of these folders or files of the package."""
    found = set()
    for folder in folders:
        place = PACKAGE / folder
        for path in [place] if place.is_file() else sorted(place.rglob('*.py')):
            for node in ast.walk(tree_of(path)):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    found.add(node.value)
    return frozenset(found)


@cache
def ros_types() -> frozenset[str]:
    """Message and service types used by the package, with and without the folder."""
    named = {text for text in texts_in('bags', 'replay', 'node') if re.fullmatch(r'\w+/(msg|srv)/\w+', text)}
    for path in PACKAGE.rglob('*.py'):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ImportFrom) and node.module and re.fullmatch(r'\w+\.(msg|srv)', node.module):
                named |= {f'{node.module.replace(".", "/")}/{alias.name}' for alias in node.names}
    return frozenset(named | {re.sub('/(msg|srv)/', '/', name) for name in named})


@cache
def topics() -> frozenset[str]:
    """Topics and services of the node, without `~/`, and topics with their own name."""
    texts = texts_in('node')
    maps = next(
        ast.literal_eval(node.value)
        for node in tree_of(PACKAGE / 'node' / 'map_publishers.py').body
        if isinstance(node, ast.Assign) and 'MAPS' in _targets(node)
    )
    # a text that ends like this is completed by the name of a map
    stems = [text[2:] for text in texts if text.startswith('~/') and text.endswith(('/', '_'))]
    return frozenset(
        {text[2:] for text in texts if text.startswith('~/')}
        | {stem + name for stem in stems for name in maps}
        | {text for text in texts_in('node', 'bags', 'replay') if re.fullmatch(r'/\w+', text)}
    )


@cache
def launch_arguments() -> frozenset[str]:
    """Arguments of the launch files: those declared by name, and parameters that are arguments as well."""
    found = set()
    for path in (ROOT / 'launch').glob('*.py'):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Call) and getattr(node.func, 'id', '') == 'DeclareLaunchArgument':
                found |= {arg.value for arg in node.args if isinstance(arg, ast.Constant)}
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict) and 'PARAMETERS' in _targets(node):
                found |= {key.value for key in node.value.keys if isinstance(key, ast.Constant)}
    return frozenset(found)


def is_value(name: str) -> bool:
    """Whether `name` is a number, or the default or a choice of a parameter."""
    texts = {text for row in table.TABLE for text in row.choices}
    for row in PARAMETERS.values():
        default = row.default
        texts |= set(default) | {f'[{", ".join(default)}]'} if isinstance(default, tuple) else {str(default)}
    return name.strip("'") in texts or re.fullmatch(NUMBER, name) is not None


@cache
def options_of(program: str) -> frozenset[str]:
    """The options of a command, or of a program in `benchmarks/`."""
    if program in COMMANDS:
        made = importlib.import_module(f'forward_grid_mapper.commands.{program}').parser()
        return frozenset(made._option_string_actions)
    found = {'-h', '--help'}
    for node in ast.walk(tree_of(ROOT / 'benchmarks' / f'{program}.py')):
        if isinstance(node, ast.Call) and getattr(node.func, 'attr', '') == 'add_argument':
            found |= {arg.value for arg in node.args if isinstance(arg, ast.Constant) and arg.value.startswith('-')}
    return frozenset(found)


@cache
def programs() -> tuple[str, ...]:
    """The commands with options, and the programs in `benchmarks/`."""
    return (*(set(COMMANDS) - {'mapper'}), *(path.stem for path in (ROOT / 'benchmarks').glob('*.py')))


# Names in code spans


def is_path(name: str, page: Path) -> bool:
    """Whether a file or folder of the repository has this name; a bare name must belong to exactly one module."""
    name = name.rstrip('/')
    for folder in (page.parent, *FOLDERS):
        if (folder / name).exists() or ('/' in name and (folder / f'{name}.py').exists()):
            return True
    return len(sources().get(name, ())) == 1


def files_of(name: str) -> list[Path]:
    """The Python files with this name, given with or without folder."""
    if '/' in name:
        return [folder / name for folder in FOLDERS if (folder / name).is_file()]
    return sources().get(name, [])


def is_member(name: str) -> bool:
    """Whether `name` is `module.name`, `module.Class.member` or `Class.member`."""
    module, _, member = name.partition('.')
    if member and any(member in names_in(path) for path in sources().get(f'{module}.py', ())):
        return True
    return bool(member) and any(name in names_in(path) for paths in sources().values() for path in paths)


def is_test(name: str) -> bool:
    """Whether `file.py::test` is a test."""
    file, _, test = name.rpartition('::')
    files = files_of(file) if file else [path for paths in sources().values() for path in paths]
    return test.startswith('test_') and any(test in names_in(path) for path in files)


def command_line(text: str, page: Path) -> str:
    """Return the fault of a command line, or '' if there is none."""
    for path in re.findall(SHOWN, text):
        if not is_path(path, page):
            return f'{path} does not exist'
    for command in re.findall(r'(?:-m|ros2 run) forward_grid_mapper (\w+)', text):
        if command not in COMMANDS:
            return f'{command} is no command'
    for name in re.findall(r'/forward_grid_mapper/(\w+)', text):
        if name not in topics() | {'share', 'config'}:
            return f'{name} is neither topic nor service'
    ours = 'forward_grid_mapper' in text or 'ros2 run' not in text
    for name in re.findall(r'(?:-p|--set) (\w+):?=', text) if ours else ():
        # NAME stands for any name
        if name not in SETTABLE and name != 'NAME':
            return f'{name} is no parameter'
    words = text.split('#', maxsplit=1)[0].split()
    for k, word in enumerate(words):
        program = Path(word).stem if word.endswith('.py') else word
        program = 'demo' if word == 'scripts/demo' else program
        if program in programs() and (program == word or '/' in word):
            given = {w for w in words[k + 1 :] if re.fullmatch(r'--?[a-z][\w-]*', w)}
            if wrong := given - options_of(program):
                return f'{program} has no option {", ".join(sorted(wrong))}'
            break
    return ''


def is_option(name: str) -> bool:
    return any(name in options_of(program) for program in programs())


def is_setting(name: str) -> bool:
    """Whether `name` is a parameter or a constant, with or without a value."""
    first = re.split(r'[ =:<>≤≥]', name)[0]
    if ':=' in name and first in launch_arguments():
        return True
    return first in PARAMETERS or re.fullmatch(r'sensors\.\S+\.pose(: .*)?', name) is not None


def is_spoken(name: str) -> bool:
    """Whether the node or a written file contains it: topics, services, diagnostics, reasons, names of results."""
    if name in REASONS or name in ODOMETRY_REASONS or name in ros_types():
        return True
    if re.sub(r'^(~/|/forward_grid_mapper/|…/)', '', name) in topics() or is_value(name):
        return True
    if f'RangeMessage.{name}' in names_in(PACKAGE / 'core' / 'messages' / 'message_types.py'):
        return True
    # the part of a key after a colon is variable; the name of a status begins with that of the node
    keys = {NODE_NAME, *(text.rstrip(': ') for text in texts_in('node'))}
    return name in keys | texts_in('files') or name.split(': ', maxsplit=1)[0] in keys


@cache
def library_names() -> frozenset[str]:
    """Names that other programs use: functions of the library, their arguments, and attributes of results."""
    found = {'grid.shape', 'grid.extent'}
    for node in ast.walk(tree_of(PACKAGE / 'library.py')):
        if isinstance(node, ast.FunctionDef):
            found |= {node.name} | {arg.arg for arg in node.args.args}
    for path in (PACKAGE / 'library.py', PACKAGE / 'files' / 'pose_files.py', PACKAGE / 'core' / 'maps' / 'map_set.py'):
        found |= {name.rpartition('.')[2] for name in names_in(path)}
    return frozenset(found)


def exists(name: str, page: Path) -> bool:
    """Whether the repository contains this name."""
    first = name.split(maxsplit=1)[0] if name.split() else ''
    if '::' in name or re.fullmatch(r'test_\w+', name):
        return is_test(name)
    if first.startswith('-'):
        return is_option(first)
    if ' ' in name and (first in COMMANDS or first.endswith('.py') or first in ('ros2', 'python', 'python3')):
        known = first in COMMANDS or '/' not in first or is_path(first, page)
        return known and not command_line(name, page)
    return (
        is_path(name, page)
        or name in COMMANDS
        or is_setting(name)
        or is_member(name)
        or f'{name}.py' in sources()
        or is_spoken(name)
        or (page.name == 'library.md' and re.split(r'[=(]', name)[0] in library_names())
        or name == 'make_maps'
    )


# Pages


def without_blocks(text: str) -> str:
    """A page without its code blocks."""
    text = re.sub(r'^```.*?^```', '', text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r'(?<=\n\n)(?: {4}.*\n|\n(?= {4}))+', '', text)


def blocks(text: str) -> list[str]:
    """The lines of the code blocks of a page, with continued lines joined, and without output of programs."""
    fenced = re.findall(r'^```(\w*)\n(.*?)^```', text, flags=re.MULTILINE | re.DOTALL)
    rest = re.sub(r'^```.*?^```', '', text, flags=re.MULTILINE | re.DOTALL)
    found = [body for kind, body in fenced if kind != 'text']
    found += re.findall(r'(?<=\n\n)(?: {4}.*\n|\n(?= {4}))+', rest)
    return [line.strip() for body in found for line in re.sub(r'\\\n\s*', '', body).splitlines() if line.strip()]


def wrong_names(text: str, page: Path, allowed: dict[str, str]) -> list[str]:
    """Names in code spans and prose that do not exist; `allowed` are exceptions."""
    wrong = []
    prose = without_blocks(text)
    for paragraph in re.split(r'\n\s*\n|\n(?=\|)', prose):
        inside: list[Path] = []
        last = 0
        for span in re.finditer(r'(`+)(.+?)\1', paragraph, flags=re.DOTALL):
            name = ' '.join(span.group(2).split())
            between = paragraph[last : span.start()]
            last = span.end()
            if inside and between in (': ', ', ', ' and ') and not name.endswith('.py'):
                if not any(name in names_in(path) for path in inside):
                    wrong.append(f'{name} is not in {inside[0].name}')
                continue
            inside = files_of(name) if paragraph[last : last + 3] == ': `' else []
            if name in DEPRECATED:
                if not SAYS_SO.search(paragraph):
                    wrong.append(f'{name} is deprecated')
            elif name not in allowed and not exists(name, page):
                wrong.append(name)
        bare = re.sub(r'(`+).+?\1|\]\([^)]*\)', '', paragraph, flags=re.DOTALL)
        wrong += [name for name in re.findall(rf'\btest_\w+|{SHOWN}', bare) if not is_path(name, page)]
    return wrong


def wrong_commands(text: str, page: Path) -> list[str]:
    """Faults of command lines in code blocks."""
    return [f'{line}: {fault}' for line in blocks(text) if (fault := command_line(line, page))]


def anchors(text: str) -> set[str]:
    """The anchors of the headings of a page."""
    heads = re.findall(r'^#+ (.+)$', without_blocks(text), flags=re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', head.lower()).replace(' ', '-') for head in heads}


def wrong_links(text: str, page: Path) -> list[str]:
    """Links and images without target; URLs are not followed."""
    wrong = []
    for target in re.findall(r'\]\(([^)\s]+)\)', without_blocks(text)):
        if re.match(r'https?:', target):
            continue
        file, _, anchor = target.partition('#')
        path = page.parent / file
        if not path.exists() or (
            anchor and anchor not in anchors(text if not file else path.read_text(encoding='utf-8'))
        ):
            wrong.append(target)
    return wrong


def wrong_defaults(text: str) -> list[str]:
    """Parameters with another default than stated: in a column `default` of tables, and in brackets
    after bold words.
    """
    stated = []
    column = None
    for line in text.splitlines():
        cells = [cell.strip().strip('`') for cell in line.strip('|').split('|')] if line.startswith('|') else []
        if 'default' in cells:
            column = cells.index('default')
        elif not cells:
            column = None
        elif column is not None and cells[0] in PARAMETERS:
            stated.append((cells[0], cells[column]))
    for bracket in re.findall(r'\*\*[^*]+\*\*\s+\(([^)]*)\)', text):
        stated += re.findall(rf'`(\w+)`\s+({NUMBER})', bracket)
    return [f'{name} {value}' for name, value in stated if name in PARAMETERS and not is_default(name, value)]


def is_default(name: str, value: str) -> bool:
    """Whether a number is the default of a parameter; other values are not compared."""
    return re.fullmatch(NUMBER, value) is None or float(value) == float(PARAMETERS[name].default)
