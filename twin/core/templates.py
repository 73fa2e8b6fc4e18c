"""Text files of other programs from Jinja templates next to the code that fills them."""

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import jinja2


def filled(package: str, template: str, context: Mapping[str, Any]) -> str:
    """Returns a template of a package with its values; a missing one raises an exception of jinja2."""
    source = files(package).joinpath(template).read_text(encoding="utf-8")
    return jinja2.Template(
        source, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    ).render(**context)
