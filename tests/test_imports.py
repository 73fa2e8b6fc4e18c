"""Who may import whom: the rooms of the design, read from the source of every module."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BASICS = {
    "twin.scenario.model", "twin.scenario.file", "twin.core.records", "twin.core.links", "twin.core.growing_array", "twin.core.geometry", "twin.errors",
    "twin.core.timing",
}  # fmt: skip
#: What each room may import of ours beside itself. The rest of twin/ (survey, cli, ...) may import everything.
ROOMS = {
    "terrains": set(),
    "scenes": {"terrains"},
    "controllers": set(),
    "twin.simulate": BASICS | {"scenes", "controllers"},
    "twin.imaging": BASICS | {"scenes"},
    "twin.estimate": BASICS,
    "twin.judge": BASICS,
    "twin.exchange": BASICS,
} | {basic: BASICS for basic in BASICS}
#: A name in scenes/ is found by where the package lies: the one look of the basics at a room.
ROOMS["twin.scenario.file"] = BASICS | {"scenes"}
OURS = ("terrains", "scenes", "controllers", "twin")


def modules():
    return [path for name in OURS for path in sorted((ROOT / name).rglob("*.py"))]


def dotted(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def within(module, package):
    return module == package or module.startswith(package + ".")


def is_module(name):
    path = ROOT.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").is_file()


def imports(tree, module=""):
    """Dotted names of all that a module imports, anywhere in it; `from a import b` is a.b where that is a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative imports hide where they point"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if is_module(name) else node.module


def forbidden(module, imported):
    """Whether this arrow is one that the design does not have."""
    room = next((room for room in ROOMS if within(module, room)), None)
    if room is None or not any(within(imported, package) for package in OURS):
        return False
    return not any(within(imported, allowed) for allowed in ROOMS[room] | {room})


@pytest.mark.parametrize("path", modules(), ids=dotted)
def test_every_import_is_an_arrow_of_the_design(path):
    module = dotted(path)
    wrong = [name for name in imports(ast.parse(path.read_text()), module) if forbidden(module, name)]
    assert not wrong, f"{module} may not import {', '.join(wrong)}"


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("terrains.reef", "from twin.errors import TwinError"),
        ("controllers.pilot", "import scenes"),
        ("scenes.builder", "from twin import geometry"),
        ("twin.estimate.vision.f2f", "from twin.world import world"),
        ("twin.estimate.vision.f2f", "import twin.imaging.optics"),
        ("twin.estimate.vision.f2f", "def f():\n    from scenes.gl import mujoco"),
        ("twin.report.survey_page", "from twin.estimate import network"),
        ("twin.imaging.optics", "from twin.simulate import vehicle"),
        ("twin.simulate.vehicle", "from twin import imaging"),
        ("twin.scenario.model", "import scenes"),
        ("twin.scenario.file", "from twin import survey"),
    ],
)
def test_an_arrow_that_the_design_does_not_have_is_found(module, line):
    assert any(forbidden(module, name) for name in imports(ast.parse(line)))


def test_estimators_do_not_know_of_the_truth():
    for path in (ROOT / "twin" / "estimate").rglob("*.py"):
        names = {node.id for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Name)}
        assert not names & {"Truth", "Shot"}, f"{dotted(path)} uses the truth"


def test_rerun_has_one_door():
    importers = {
        dotted(path)
        for path in modules()
        if any(within(name, "rerun") for name in imports(ast.parse(path.read_text())))
    }
    assert importers <= {"twin.report.recording"}
