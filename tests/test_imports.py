"""The architecture: who imports whom, read from the source of every module and compared with docs/architecture.md."""

import ast
import functools
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
OURS = ("terrains", "scenes", "controllers", "twin")
DOCUMENT = (ROOT / "docs" / "architecture.md").read_text()


@functools.cache
def modules():
    return [path for name in OURS for path in sorted((ROOT / name).rglob("*.py"))]


@functools.cache
def tree_of(path):
    """Returns the syntax tree of a module."""
    return ast.parse(path.read_text())


@functools.cache
def nodes_of(path):
    """Returns all nodes of the syntax tree of a module."""
    return tuple(ast.walk(tree_of(path)))


def dotted(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[0] != "twin":  # twin/terrains, twin/scenes and twin/controllers are links to these folders
        parts = ("twin", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {dotted(path) for path in modules()}


def table():
    """Returns the rooms of the table, in its order, each with the short names of those that it may import."""
    rows = re.findall(r"^\| `([\w.]+)` \|[^|]*\|([^|]*)\|$", DOCUMENT, re.MULTILINE)
    return {room: {name.strip() for name in allowed.split(",") if name.strip()} for room, allowed in rows}


ROOMS = table()


def short(room):
    return room.rpartition(".")[2]


def within(module, package):
    return module == package or module.startswith(package + ".")


def room_of(module):
    """Returns the innermost room of a module; the package `twin` itself holds only its public API."""
    found = [room for room in ROOMS if within(module, room) and (room != "twin" or module == "twin")]
    return max(found, key=len, default=None)


def imports(nodes, module=""):
    """Yields the modules that a module imports, anywhere in it; `from a import b` is a.b where that is a module."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative imports hide where they point"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in NAMES else node.module


def is_forbidden(module, imported):
    """Returns whether the table does not allow this import."""
    if not within(imported, "twin"):
        return False
    room, target = room_of(module), room_of(imported)
    return room != target and (target is None or short(target) not in ROOMS[room])


@functools.cache
def arrows():
    """Returns the imports between modules of the project: {module: {imported}}."""
    return {
        module: {name for name in imports(nodes_of(path), module) if name in NAMES and name != module}
        for path, module in ((path, dotted(path)) for path in modules())
    }


def room_arrows():
    """Returns the imports between rooms, by short names."""
    found = {short(room): set() for room in ROOMS}
    for module, targets in arrows().items():
        found[short(room_of(module))] |= {short(room_of(t)) for t in targets} - {short(room_of(module))}
    return found


def circle(graph):
    """Returns the nodes of one cycle of a directed graph {node: {target}}; empty where there is none."""
    done, path = set(), []

    def visit(node):
        if node in path:
            return path[path.index(node) :]
        if node in done:
            return []
        path.append(node)
        for target in sorted(graph.get(node, ())):
            if found := visit(target):
                return found
        path.pop()
        done.add(node)
        return []

    return next((found for node in sorted(graph) if (found := visit(node))), [])


@pytest.mark.parametrize("path", modules(), ids=dotted)
def test_every_import_is_in_the_table(path):
    module = dotted(path)
    assert room_of(module) is not None, f"{module} is in no room of docs/architecture.md"
    wrong = [name for name in imports(nodes_of(path), module) if is_forbidden(module, name)]
    assert not wrong, f"{module} may not import {', '.join(wrong)}"


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("twin.terrains.generate", "from twin.scenario import model"),
        ("twin.controllers.tracking", "from twin import scenes"),
        ("twin.scenes.builder", "from twin.scenario import model"),
        ("twin.core.links", "from twin.estimate import network"),
        ("twin.estimate.vision.f2f", "from twin.world import world"),
        ("twin.estimate.vision.f2f", "import twin.imaging.light.optics"),
        ("twin.estimate.vision.f2f", "from twin.estimate import network"),
        ("twin.estimate.pipeline", "def f():\n    from twin.scenes.gl import mujoco"),
        ("twin.estimate.pipeline", "from twin.scenario.model import Scenario"),
        ("twin.judge.metrics", "from twin.estimate import network"),
        ("twin.judge.metrics", "from twin.report import number_formats"),
        ("twin.imaging.light.optics", "from twin.simulate import mujoco_vehicle"),
        ("twin.surrogate.vision", "from twin.studies import search"),
        ("twin.surrogate.vision", "from twin.surrogate_fit import fit"),
        ("twin.tuning.search", "from twin.app import console"),
        ("twin.scenario.file", "from twin import survey"),
    ],
)
def test_an_import_that_the_table_does_not_allow_is_found(module, line):
    assert any(is_forbidden(module, name) for name in imports(ast.walk(ast.parse(line))))


def test_every_module_finds_the_names_that_it_imports():
    """Two rooms that change at the same time may each be right alone."""
    ours = sorted(NAMES - {"twin.__main__", "twin.warm_up"})
    code = f"import importlib\nfor name in {ours}:\n    importlib.import_module(name)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_there_are_no_circles_between_modules_nor_between_rooms():
    assert circle(arrows()) == []
    assert circle(room_arrows()) == []
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]


def test_the_diagram_is_that_of_the_imports():
    """Every arrow of the diagram is an import, and every import between rooms follows arrows of the diagram."""
    drawn = {}
    for start, end in re.findall(r"^    (\w+) --> (\w+)$", DOCUMENT, re.MULTILINE):
        drawn.setdefault(start, set()).add(end)
    real = {room: targets for room, targets in room_arrows().items() if room not in ("twin", "__main__")}
    invented = {(a, b) for a, ends in drawn.items() for b in ends if b not in real[a]}
    assert not invented, f"arrows without an import: {invented}"

    def reached(room):
        return {room}.union(*(reached(target) for target in drawn.get(room, ())))

    missing = {(room, target) for room, targets in real.items() for target in targets - reached(room)}
    assert not missing, f"imports without an arrow: {missing}"


def test_estimators_do_not_use_the_truth():
    for path in (ROOT / "twin" / "estimate").rglob("*.py"):
        names = {node.id for node in nodes_of(path) if isinstance(node, ast.Name)}
        assert not names & {"Truth", "Mission", "World"}, f"{dotted(path)} uses the truth"


def test_the_estimators_load_neither_simulator_nor_scenario():
    code = "import sys, twin.estimate; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    forbidden = (
        "mujoco",
        "OpenGL",
        "pydantic",
        "twin.scenes",
        "twin.terrains",
        "twin.controllers",
        "twin.world",
        "twin.scenario",
    )
    assert [name for name in loaded if any(within(name, package) for package in forbidden)] == []


SETTINGS = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "OPENBLAS_NUM_THREADS")


def test_an_import_changes_no_setting_of_the_process():
    """Also where there is no module `resource` (Windows)."""
    code = f"""
import os, sys
sys.modules["resource"] = None
import twin.scenes.builder, twin.estimate, twin.imaging.scene.renderer
assert "mujoco" not in sys.modules and "OpenGL" not in sys.modules
assert not os.environ.keys() & {set(SETTINGS)}
"""
    variables = {key: value for key, value in os.environ.items() if key not in SETTINGS}
    done = subprocess.run([sys.executable, "-c", code], env=variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_rerun_is_imported_by_one_module():
    importers = {dotted(path) for path in modules() if any(within(name, "rerun") for name in imports(nodes_of(path)))}
    assert importers == {"twin.report.recording"}


def parameters(node):
    arguments = node.args
    names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return [name for name in names if name not in ("self", "cls")]


def test_no_function_outside_compiled_kernels_has_more_than_seven_parameters():
    """The parameters of a command are the options of the command line, however many."""
    exempt = ("kernel", "app.command")
    wide = [
        f"{dotted(path)}.{node.name}"
        for path in modules()
        for node in nodes_of(path)
        if isinstance(node, ast.FunctionDef)
        and len(parameters(node)) > 7
        and not any(name in ast.unparse(decorator) for decorator in node.decorator_list for name in exempt)
    ]
    assert wide == []


def test_every_class_name_has_one_meaning():
    found = {}
    for path in modules():
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(dotted(path))
    assert {name: places for name, places in found.items() if len(places) > 1} == {}
