"""Loading of plug-ins by module and class or by entry point, and the errors of plug-ins that cannot be loaded."""

import sys
from importlib.metadata import EntryPoint

import pytest

from twin import cli
from twin.errors import ScenarioError, TwinError, described
from twin.plugin import loading
from twin.scenario.file import load_scenario
from twin.studies.study_file import load_study
from twin.studies.surveys import surveys


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Returns a function that writes a module that can be imported, and registers an entry point for each name."""
    entries = []
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(loading, "entry_points", lambda group: [e for e in entries if e.group == group])

    def write(name, text, **registered):
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.delitem(sys.modules, name, raising=False)
        entries.extend(EntryPoint(key, f"{name}:{value}", loading.CONTROLLERS) for key, value in registered.items())

    return write


def test_a_class_is_loaded_by_module_and_name_and_by_entry_point(package):
    package("one", "class Lqr:\n    class Inner: pass", lqr="Lqr")
    by_module = loading.load("control.plugin", loading.CONTROLLERS, "one:Lqr")
    assert by_module is loading.load("control.plugin", loading.CONTROLLERS, "lqr")
    assert loading.load("control.plugin", loading.CONTROLLERS, "one:Lqr.Inner") is by_module.Inner
    ((made, target),) = loading.registered(loading.CONTROLLERS, lambda plugin, target: (plugin, target))
    assert isinstance(made, by_module) and target == "one:Lqr"
    assert loading.registered(loading.TERRAINS, lambda plugin, target: plugin) == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("absent:Lqr", "control.plugin: absent:Lqr: ModuleNotFoundError: No module named 'absent'"),
        ("broken:Lqr", "control.plugin: broken:Lqr: ValueError: two lines"),
        ("leaves:Lqr", "control.plugin: leaves:Lqr: SystemExit: 3"),
        ("good:Pid", "control.plugin: good:Pid: AttributeError: module 'good' has no attribute 'Pid'"),
        ("good:N", "control.plugin: good:N: TypeError: N is not a class"),
        (
            "lqg",
            "control.plugin: lqg: no installed package registers this name in twin.controllers (did you mean lqr?)",
        ),
        (":", "control.plugin: :: ValueError: Empty module name"),
    ],
)
def test_a_plugin_that_cannot_be_loaded_is_refused_with_its_name(package, name, message):
    package("good", "N = 3\nclass Lqr: pass", lqr="Lqr")
    package("broken", "raise ValueError('two\\nlines')")
    package("leaves", "raise SystemExit(3)")
    with pytest.raises(TwinError) as refused:
        loading.load("control.plugin", loading.CONTROLLERS, name)
    assert str(refused.value).startswith(message)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize("section", ["control", "estimate", "terrain"])
def test_a_scenario_names_a_module_only_with_permission(section, tmp_path):
    given = f'{section}.plugin="os:_exit"'
    (tmp_path / "scene.toml").write_text(f'[{section}]\nplugin = "os:_exit"\n')
    refused = f"{section}.plugin: 'os:_exit' runs code of any module (allowed: an installed entry point of twin."
    for source, overrides, place in (
        ("quickstart", [given], "--set: "),
        (tmp_path / "scene.toml", [], "scene.toml:2: "),
    ):
        with pytest.raises(ScenarioError) as error:
            load_scenario(source, overrides)
        assert place + refused in str(error.value) and len(error.value.lines) == 1
        assert getattr(load_scenario(source, overrides, allow_plugins=True), section).plugin == "os:_exit"
    assert getattr(load_scenario("quickstart", [f"{section}.plugin=lqr"]), section).plugin == "lqr"


@pytest.mark.parametrize("key", ["set", "vary", "base"])
def test_a_study_names_a_module_only_with_permission(key, tmp_path):
    (tmp_path / "scene.toml").write_text('[control]\nplugin = "os:_exit"\n' if key == "base" else "")
    named = {
        "set": '[set]\ncontrol.plugin = "os:_exit"',
        "vary": 'vary.control.plugin = { choice = ["os:_exit", "x:Y"] }',
    }
    text = f'scenario = "scene.toml"\nsampling.samples = 2\n{named.get(key, "")}\n'
    (tmp_path / "study.toml").write_text(
        text + ("" if key == "vary" else "[vary]\nplan.tracks = { choice = [1, 2] }\n")
    )
    with pytest.raises(ScenarioError, match="runs code of any module"):
        list(surveys(load_study(tmp_path / "study.toml"), tmp_path))
    flown = next(surveys(load_study(tmp_path / "study.toml", allow_plugins=True), tmp_path))
    assert ":" in (flown.scenario.control.plugin or "")


def test_a_replay_names_a_module_only_with_permission(tmp_path):
    with pytest.raises(TwinError, match="^--estimator: 'os:_exit' runs code of any module"):
        cli.replay(tmp_path, estimator="os:_exit")


def test_a_registered_plugin_that_cannot_be_imported_is_refused_with_the_name_of_its_entry_point(package):
    package("broken", "import absent", bad="Lqr")
    with pytest.raises(TwinError, match="^twin.controllers bad: broken:Lqr: ModuleNotFoundError"):
        loading.registered(loading.CONTROLLERS, lambda plugin, target: plugin)


def test_the_description_of_an_exception_is_one_line_without_control_characters():
    assert described(ValueError("first\n\x1b[31msecond")) == "ValueError: first ?[31msecond"
