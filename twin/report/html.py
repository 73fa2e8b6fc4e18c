"""Renders pages and texts from Jinja templates; all pages share a style sheet, number formats and a list of terms."""

import re
from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any, NamedTuple

import jinja2

from twin.report import number_formats, words

_SHARED_TEMPLATES = "twin.report"
#: Number formats by the names that they have in templates.
_FILTERS = {
    "length": number_formats.length, "percent": number_formats.percent, "plain": number_formats.plain,
    "ms": number_formats.milliseconds, "angle": number_formats.angle, "ratio": number_formats.ratio,
    "milliradians": number_formats.milliradians, "area_le90": number_formats.area_le90,
}  # fmt: skip


def render_page(package: str, template: str, context: Mapping[str, Any]) -> str:
    """Returns a template as self-contained HTML; files that are not in `package` are taken from `twin.report`."""
    page = _rendered(package, template, context, autoescape=True)
    # for narrow screens (page.css), cells carry the names of their columns, and images can have the focus
    page = re.sub(r"<table>.*?</table>", _with_column_names, page, flags=re.DOTALL)
    return page.replace("<img ", '<img tabindex="0" ')


def render_text(template: str, context: Mapping[str, Any], package: str = _SHARED_TEMPLATES) -> str:
    """Returns a template of a package, by default this, rendered as text; missing variables are dashes."""
    return _rendered(package, template, context, undefined=jinja2.ChainableUndefined)


def render_rows(template: str, context: Mapping[str, Any], package: str = _SHARED_TEMPLATES) -> list[tuple[str, str]]:
    """Returns (name, value) of each line "name | value" of a text template."""
    lines = (line.partition(" | ") for line in render_text(template, context, package).splitlines())
    return [(name, value) for name, _, value in lines]


class Paragraph(NamedTuple):
    """Answer to one question on the first screen of a page: text, then a list of sentences."""

    title: str
    text: str
    items: list[str]


def render_paragraphs(template: str, context: Mapping[str, Any], package: str) -> list[Paragraph]:
    """Returns the paragraphs of a text template that are not empty: lines "# title", text, lines "- item"."""
    _, *parts = re.split(r"^# (.*)\n", render_text(template, context, package), flags=re.MULTILINE)
    bodies = ([" ".join(part.split()) for part in re.split(r"^- ", body, flags=re.MULTILINE)] for body in parts[1::2])
    found = [Paragraph(title, text, items) for title, (text, *items) in zip(parts[::2], bodies, strict=True)]
    return [paragraph for paragraph in found if paragraph.text or paragraph.items]


def lines_of(paragraphs: list[Paragraph]) -> str:
    """Returns paragraphs as text, a line each, with their titles except that of the first, the answer."""
    titles = ("", *(paragraph.title for paragraph in paragraphs[1:]))
    texts = (" ".join([one.text, *one.items]).strip() for one in paragraphs)
    return "\n".join(f"{title} {text}".strip() for title, text in zip(titles, texts, strict=True))


def _rendered(package: str, template: str, context: Mapping[str, Any], **options: Any) -> str:
    environment = jinja2.Environment(
        **options,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(lambda name: _source(package, name) or _source(_SHARED_TEMPLATES, name)),
    )
    environment.filters |= {name: _of_defined(number) for name, number in _FILTERS.items()}
    environment.filters |= {"with_unit": number_formats.with_unit, "words": words.words, "label": words.label}
    environment.filters |= {"with_words": words.with_words}
    return environment.get_template(template).render(**context)


def _of_defined(number: Callable[[Any], str]) -> Callable[[Any], str]:
    """Returns a number format that takes an undefined value as None."""
    return lambda value: number(None if isinstance(value, jinja2.Undefined) else value)


def _with_column_names(table: re.Match[str]) -> str:
    """Returns the HTML of a table whose header is its first row."""
    text = re.sub(r"(?<=[a-z\d][._])(?=[a-z][^<>]*<)", "<wbr>", table[0])  # keys may be broken at their dots
    names = [re.sub(r"<.*?>", "", name) for name in re.findall(r"<th>(.*?)</th>", text, re.DOTALL)]

    def row(match: re.Match[str]) -> str:
        column = iter(names)
        return re.sub(r"<td\b", lambda _: f'<td data-column="{next(column, "")}"', match[0])

    return re.sub(r"<tr>.*?</tr>", row, text, flags=re.DOTALL) if names else table[0]


def _source(package: str, name: str) -> str | None:
    file = files(package).joinpath(name)
    return file.read_text(encoding="utf-8") if file.is_file() else None
