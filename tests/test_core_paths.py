"""Paths that the file system rejects have a reason."""

import pytest

from twin.core.user_files import path_problem


def test_links_to_themselves_and_to_missing_files_are_problems_and_new_paths_are_not(tmp_path):
    loop, dangling = tmp_path / "loop", tmp_path / "dangling"
    loop.symlink_to("loop")
    dangling.symlink_to("nothing")
    for path in (loop, loop / "run"):
        assert "symbolic links" in (path_problem(path) or "")
    assert "missing file" in (path_problem(dangling) or "")
    for path in (tmp_path, tmp_path / "new" / "run"):
        assert path_problem(path) is None


@pytest.mark.parametrize(("name", "reason"), [("a\0b", "null byte"), ("x" * 300, "too long")])
def test_an_invalid_name_is_a_problem(tmp_path, name, reason):
    assert reason in (path_problem(tmp_path / name) or "")
