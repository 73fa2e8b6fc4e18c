"""Self-contained pages of one look: templates of any room, in the style and with the words of the survey report."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import jinja2

from twin.report import wording

_HOME = "twin.report"  # where the style of all pages lies


def render_page(package: str, template: str, context: Mapping[str, Any]) -> str:
    """The template of a package as HTML."""
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(lambda name: _source(package, name) or _source(_HOME, name)),
    )
    environment.filters.update(
        length=wording.length,
        percent=wording.percent,
        plain=wording.plain,
        ms=wording.milliseconds,
        angle=wording.angle,
        small_angle=wording.small_angle,
        factor=wording.factor,
    )
    return environment.get_template(template).render(**context)


def _source(package: str, name: str) -> str | None:
    file = files(package).joinpath(name)
    return file.read_text(encoding="utf-8") if file.is_file() else None
