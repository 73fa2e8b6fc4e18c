"""Mutated scenarios: a strategy that gives odd values to random keys of the model, and a campaign over many of them.

`python tests/hostile_scenarios.py 2000` draws 2000 scenarios, loads and plans each in a separate process with a limit
on time and memory, and prints how many were accepted, refused with TwinError, crashed or exceeded a limit.
"""

from __future__ import annotations

import json
import multiprocessing
import random
import resource
import sys
import tempfile
import time
import traceback
import types
from pathlib import Path
from typing import Any, get_args, get_origin

from hypothesis import strategies as st
from pydantic import BaseModel

from twin.errors import TwinError
from twin.scenario.model import Scenario

#: Largest wall time of loading and planning one scenario [s]; largest address space of the process above its start.
LIMIT_S, LIMIT_BYTES = 60.0, 3 * 2**30
LONG = 5000

BASE = """
seed = 1
[terrain]
size_m = [5.0, 4.0]
grid_m = 0.1
texture_px_m = 0.05
[imaging]
fidelity = "surrogate"
[plan]
area_m = [2.0, 1.0]
altitude_m = 2.0
[[lamps]]
position_m = [0.25, 0.35, -0.05]
[[beacons]]
position_m = [0.5, 0.2, 1.0]
"""

NUMBERS = (
    "nan", "inf", "-inf", "0", "-0.0", "-1", "1", "2", "1e308", "-1e308", "1e-308", "5e-324", "1e9", "1e5", "1e-9",
    "123456789123456789", "9" * LONG, "-" + "9" * LONG, "0x" + "f" * LONG, "9" * 4000, "1e99999", "0.0011",
)  # fmt: skip
TEXTS = (
    '""', '"x"', '"\\u0000"', '"a\\u0000b"', '"[/x]"', '"[bold"', '"$\\\\frac"', '"$x_{"', '"\\u001b[31m"', '"<b>&"',
    '"../../x"', '"/dev/zero"', '"/proc/self/mem"', '"/"', '"."', '"${TWIN_DATA}"', f'"{"n" * LONG}"',
    f'"{"d/" * LONG}"', '"\\uFEFF"', '"a\\nb"', '"~"', '"%s{}"', '"rendered"', '"file"', '"loops"', '"kinematic"',
)  # fmt: skip
OTHERS = (
    "true", "[]", "[[]]", "{}", "{ a = 1 }", "1979-05-27", "1979-05-27T07:32:00Z", "[" * LONG + "]" * LONG,
    "[" * 150 + "]" * 150, "{a=" * 150 + "1" + "}" * 150, "{a=" * LONG + "1" + "}" * LONG, "[1, 'x']",
    "[" + "1.0," * 2000 + "]", "[[0, 1], [90, 0]]",
)  # fmt: skip
LOOSE = (
    "[" * 3000, "a" + ".a" * 1000 + " = 1", "a" + ".a" * 100_000 + " = 1", "\0", "plan = 3", "[plan]\n[plan]",
    'extends = "scenario.toml"', 'extends = "link.toml"', 'extends = "/dev/zero"', f'extends = "{"x" * LONG}"',
    'extends = "a\\u0000b"', "extends = 3", "extends = []", "'' = 1", '"[/x]" = 1', '"\\u0000" = 1',
    f"{'k' * LONG} = 1",
    '"a.b" = 1', "[require]\n'[/x]' = 1", "[[plan]]", "[lamps]", "lamps = [[]]",
    "[a." + ".".join("b" * 900) + "]",
)  # fmt: skip


def keys_of(model: type[BaseModel], prefix: str = "") -> list[tuple[str, Any]]:
    """Returns (dotted key, field) of every value of a model; items of lists have the number 0."""
    found: list[tuple[str, Any]] = []
    for name, field in model.model_fields.items():
        inner = [a for a in _arguments(field.annotation) if isinstance(a, type) and issubclass(a, BaseModel)]
        is_list = get_origin(field.annotation) is tuple
        found.append((prefix + name, field))
        if inner:
            found += keys_of(inner[0], f"{prefix}{name}." + ("0." if is_list else ""))
    return found


def _arguments(annotation: Any) -> list[Any]:
    if isinstance(annotation, types.UnionType) or get_origin(annotation) is tuple:
        return [a for argument in get_args(annotation) for a in _arguments(argument)]
    return [annotation]


KEYS = dict(keys_of(Scenario))


def near_values(key: str) -> list[str]:
    """Returns the literals of a key, its bounds and the values next to them, as TOML; vectors repeat the value."""
    field = KEYS[key]
    bounds = [getattr(m, name) for m in field.metadata for name in ("ge", "gt", "le", "lt") if hasattr(m, name)]
    numbers = [repr(type(b)(b * f)) for b in bounds for f in (1, 0.999, 1.001)]
    literals = [json.dumps(v) for v in get_args(field.annotation) if isinstance(v, str | int)]
    if get_origin(field.annotation) is tuple:
        length = len(get_args(field.annotation))
        scalars = ("1.0", "0.001", "-0.5", "3.0", "90.0", "1000.0", "1e5", "1e-9", "5e-324", *NUMBERS)
        return [f"[{', '.join([n] * length)}]" for n in scalars] + [f"[{n}, 1.0]" for n in scalars]
    return [*numbers, *literals] or ["1.0", "true", "false"]


NEAR = {key: near_values(key) for key in KEYS}
ODD = (*NUMBERS, *TEXTS, *OTHERS)


def mutations() -> st.SearchStrategy[list[tuple[str, str]]]:
    """Returns lists of (dotted key, TOML value); the key is empty for a loose line at the top of the file."""
    keys = st.sampled_from(sorted(KEYS))
    near = keys.flatmap(lambda key: st.tuples(st.just(key), st.sampled_from(NEAR[key])))
    odd = st.tuples(keys, st.sampled_from(ODD))
    loose = st.tuples(st.just(""), st.sampled_from(LOOSE))
    return st.lists(near, min_size=1, max_size=6) | st.lists(near | odd | loose, min_size=1, max_size=3)


def draw(n_cases: int, seed: int = 0) -> list[list[tuple[str, str]]]:
    """Returns random mutated scenarios: 40 % with values in or next to their range, 45 % with odd ones, 15 % loose."""
    rng = random.Random(seed)
    keys, sizes = sorted(KEYS), [key for key in KEYS if key.startswith(("plan.", "terrain.", "map.", "rig."))]

    def near(pool: list[str]) -> tuple[str, str]:
        key = rng.choice(pool)
        return key, rng.choice(NEAR[key])

    cases = []
    for _ in range(n_cases):
        kind = rng.random()
        if kind < 0.4:
            cases.append([near(sizes if rng.random() < 0.5 else keys) for _ in range(rng.randint(1, 4))])
        elif kind < 0.85:
            cases.append([(rng.choice(keys), rng.choice(ODD))] + [near(keys) for _ in range(rng.randint(0, 1))])
        else:
            cases.append([("", rng.choice(LOOSE))])
    return cases


def write_case(folder: Path, changes: list[tuple[str, str]]) -> tuple[Path, list[str]]:
    """Writes scenario.toml, with the loose lines of a case, and returns it with the overrides of the case."""
    file, link = folder / "scenario.toml", folder / "link.toml"
    if not link.is_symlink():
        link.symlink_to(link)
    loose = [text for key, text in changes if not key]
    file.write_text("\n".join(loose) + BASE, encoding="utf-8")
    return file, [f"{key}={value}" for key, value in changes if key]


def write_inline(folder: Path, changes: list[tuple[str, str]]) -> tuple[Path, list[str]]:
    """As `write_case`, but all values are in the file and the scenario has no overrides."""
    file, _ = write_case(folder, changes)
    lines = [text for key, text in changes if not key]
    given = {key: value for key, value in changes if key}
    dotted = [f"{key} = {value}" for key, value in given.items() if ".0." not in key]
    base = folder / "base.toml"
    base.write_text(BASE, encoding="utf-8")
    file.write_text("\n".join([*lines, *([] if lines else ['extends = "base.toml"']), *dotted]) + "\n")
    return file, [f"{key}={value}" for key, value in given.items() if ".0." in key]


def attempt(file: Path, overrides: list[str]) -> str:
    """Loads and plans a scenario; returns "accepted" or the text of the TwinError. Any other exception is raised."""
    from twin.planning.summary import summarise
    from twin.scenario.file import dump_toml, load_scenario
    from twin.world.mission import prepare

    try:
        mission = prepare(load_scenario(file, overrides))
        summarise(mission)
    except TwinError as error:
        return f"refused: {error}"
    dump_toml(mission.scenario)
    return "accepted"


def _work(cases: list[list[tuple[str, str]]], first: int, step: int, pipe: Any) -> None:
    """Attempts the cases first, first + step, ... and sends (number, None) before and (number, outcome) after each."""
    from twin.planning.summary import summarise  # noqa: F401 (imported before memory is limited)
    from twin.world import mission  # noqa: F401

    with tempfile.TemporaryDirectory() as folder, open("/proc/self/statm") as statm:
        size = int(statm.read().split()[0]) * resource.getpagesize() + LIMIT_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (size, size))
        for number in range(first, len(cases), step):
            write = write_inline if number % 2 else write_case
            pipe.send((number, None))
            try:
                outcome = attempt(*write(Path(folder), cases[number]))
            except BaseException as error:
                outcome = f"CRASH {type(error).__name__}: {''.join(traceback.format_exception(error))[-1500:]}"
            pipe.send((number, outcome))


def campaign(n_cases: int, n_processes: int = 2) -> dict[int, tuple[str, float]]:
    """Returns outcome and wall time [s] of each case; a process that exceeds the time limit is ended and replaced."""
    cases, results = draw(n_cases), {}
    for start in range(n_processes):
        first = start
        while first < len(cases):
            ours, theirs = multiprocessing.get_context("fork").Pipe()
            worker = multiprocessing.get_context("fork").Process(target=_work, args=(cases, first, n_processes, theirs))
            worker.start()
            theirs.close()
            began, number = time.monotonic(), first
            while True:
                if not ours.poll(LIMIT_S):
                    results[number] = ("HANG", time.monotonic() - began)
                    break
                try:
                    number, outcome = ours.recv()
                except EOFError:
                    if number not in results:
                        results[number] = (f"CRASH: the process ended, {worker.exitcode}", time.monotonic() - began)
                    break
                if outcome is None:
                    began = time.monotonic()
                else:
                    results[number] = (outcome, time.monotonic() - began)
            worker.kill()
            worker.join()
            first = number + n_processes
    return results


def main() -> None:
    """Runs a campaign and prints the counts and every case that crashed or exceeded a limit."""
    n_cases = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    cases, results = draw(n_cases), campaign(n_cases)
    for number, (outcome, wall_s) in sorted(results.items()):
        if outcome.startswith(("CRASH", "HANG")):
            shown = [(key, value[:60]) for key, value in cases[number]]
            print(f"--- {number} {wall_s:.1f} s {shown}\n{outcome}")
    kinds = [outcome.split()[0].rstrip(":") for outcome, _ in results.values()]
    slowest = max(wall_s for _, wall_s in results.values())
    print({kind: kinds.count(kind) for kind in sorted(set(kinds))}, f"slowest {slowest:.1f} s")


if __name__ == "__main__":
    main()
