"""Paths that the file system rejects have a reason."""

import pytest

from twin.core.paths import path_problem


def test_a_link_to_itself_is_a_problem_and_a_link_to_nothing_is_none(tmp_path):
    loop, dangling = tmp_path / "loop", tmp_path / "dangling"
    loop.symlink_to("loop")
    dangling.symlink_to("nothing")
    for path in (loop, loop / "run"):
        assert "symbolic links" in (path_problem(path) or "")
    for path in (dangling, tmp_path, tmp_path / "new" / "run"):
        assert path_problem(path) is None


@pytest.mark.parametrize(("name", "reason"), [("a\0b", "null byte"), ("x" * 300, "too long")])
def test_an_invalid_name_is_a_problem(tmp_path, name, reason):
    assert reason in (path_problem(tmp_path / name) or "")
