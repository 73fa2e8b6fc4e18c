"""Loading of plug-ins by module and class or by entry point, and the errors of plug-ins that cannot be loaded."""

import sys
from importlib.metadata import EntryPoint

import pytest

from twin.errors import TwinError, described
from twin.plugin import loading


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
    assert loading.registered(loading.CONTROLLERS) == [loading.Registered("lqr", "one:Lqr", by_module)]
    assert loading.registered(loading.TERRAINS) == []


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


def test_a_registered_plugin_that_cannot_be_imported_is_refused_with_the_name_of_its_entry_point(package):
    package("broken", "import absent", bad="Lqr")
    with pytest.raises(TwinError, match="^twin.controllers bad: broken:Lqr: ModuleNotFoundError"):
        loading.registered(loading.CONTROLLERS)


def test_the_description_of_an_exception_is_one_line_without_control_characters():
    assert described(ValueError("first\n\x1b[31msecond")) == "ValueError: first ?[31msecond"
